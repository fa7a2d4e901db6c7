"""The tensors of one number of streams that stay where they are from call to call, and the call between them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from ttscompile.core.coercion import Array
from ttscompile.core.lattice import BoolArray
from ttscompile.runtimes.backend import Call, fill_initial, fill_offset, hold_known, stream_type
from ttscompile.runtimes.instructions import Instructions

from .loop import denoise
from .network import Parts, StreamsNetwork
from .sampler import Advance


class Inlet:
    """A tensor of the device, and what the host writes to once a call: on the CPU the memory of the tensor itself."""

    def __init__(self, shape: tuple[int, ...], dtype: str, device: torch.device) -> None:
        self.tensor = torch.zeros(shape, dtype=getattr(torch, dtype), device=device)
        self._host = self.tensor
        if device.type != "cpu":
            self._host = torch.zeros(shape, dtype=self.tensor.dtype, pin_memory=device.type == "cuda")
        self.array: Array = self._host.numpy()

    def send(self) -> None:
        """Copy what was written."""
        if self._host is not self.tensor:
            self.tensor.copy_(self._host, non_blocking=True)


class Workspace:
    """Tensors for B streams: the denoised sample of the last call, ``[B, T, D]``, among them.

    Entries of the rollout cache, by flat index ``k * blocks + b``, are taken when they are first kept.
    """

    def __init__(self, parts: Parts, streams: int) -> None:
        spec, device = parts.manifest.spec, parts.device
        self._kind = stream_type(parts.manifest, streams)
        self._parts, self.streams, self._sampler = parts, streams, spec.sampler
        (horizon, dimensions), steps = spec.sample, spec.sampler.steps
        self._horizon = horizon
        types = {key: "float32" if one.normalizer else one.dtype for key, one in spec.inputs.items()}
        self._obs = {key: Inlet((streams, *one.shape), types[key], device) for key, one in spec.inputs.items()}
        self._initial = Inlet((streams, horizon, dimensions), "float32", device)
        columns = (1 + spec.sampler.memories) * horizon
        self._offset = Inlet((steps, dimensions, streams, columns), "float32", device)
        self._free = Inlet((dimensions, 1, horizon), "float32", device)
        self.network = StreamsNetwork(parts, {key: inlet.tensor for key, inlet in self._obs.items()}, streams)
        self.result = torch.zeros((streams, horizon, dimensions), device=device)
        self.rollout: dict[int, Tensor] = {}

    def entry(self, cell: int) -> Tensor:
        """An entry of the rollout cache; a new one holds zeros."""
        if cell not in self.rollout:
            self.rollout[cell] = self._parts.zeros(self._kind.at(self.streams), self._kind.dtype)
        return self.rollout[cell]

    def load(self, call: Call) -> None:
        """Take in what a call is given."""
        known = call.known
        for key, value in call.obs.items():
            np.copyto(self._obs[key].array, value)
        fill_initial(self._initial.array, call.noise, known)
        offset, free = self._offset.array[..., : self._horizon], self._free.array
        fill_offset(offset, self._sampler, call.noise, call.correction)
        free.fill(1)
        if known is not None:
            hold_known(offset, known)
            free[known.channels, :, known.positions] = 0
        for inlet in (*self._obs.values(), self._initial, self._offset, self._free):
            inlet.send()

    def call(self, plan: Instructions, keep: BoolArray, advance: Advance) -> None:
        """The loop, from what was loaded and the prologue made to ``result`` and the rollout cache."""
        offset = self._offset.tensor
        read = None
        if advance.reading is not None:
            read, added = advance.of_condition(self.network.condition())
            own, rest = offset[..., : self._horizon], offset[..., self._horizon :]
            offset = torch.cat([own + added * self._free.tensor, rest], 3)
        kept, initial, free = frozenset(np.flatnonzero(keep).tolist()), self._initial.tensor, self._free.tensor
        entries = {cell: self.rollout[cell] for cell in np.flatnonzero(plan.rollout).tolist()}
        sample, residuals = denoise(self.network, plan, kept, advance, initial, offset.unbind(), entries, read, free)
        self.result.copy_(sample)
        for cell, residual in residuals.items():
            self.rollout[cell].copy_(residual)

    def take(self, whole: Workspace, index: Tensor, plan: Instructions) -> None:
        """What some streams of a batch have before the loop: inputs, contexts, and residuals that a plan reads."""
        self.network.contexts.take(whole.network.contexts, index)
        self._initial.tensor.copy_(whole._initial.tensor[index])
        self._offset.tensor.copy_(whole._offset.tensor[:, :, index])
        self._free.tensor.copy_(whole._free.tensor)
        for cell in np.flatnonzero(plan.rollout).tolist():
            self.entry(cell).copy_(whole.rollout[cell].index_select(self._kind.batch_axis or 0, index))

    def give(self, whole: Workspace, index: Tensor, cells: Iterable[int]) -> None:
        """Put the result of some streams, and their residuals of these cells, into those of the batch."""
        whole.result[index] = self.result
        for cell in cells:
            whole.entry(cell).index_copy_(self._kind.batch_axis or 0, index, self.rollout[cell])
