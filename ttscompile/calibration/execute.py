"""Many plans at once: the meaning of the reference runtime for calls that are independent of each other.

A search tries thousands of plans, most of them alike. So plans go through the loop together, in one batch of
``plans x calls`` streams, and a step in which no plan computes anything costs one addition. No plan here reads the
rollout cache: what one call leaves for the next is the reference runtime's business. Tests hold this against
``ReferenceModel.rollout``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..artifact.load import Artifact
from ..correction import Correction
from ..errors import IllegalPlanError
from ..lattice import BoolArray, PlanArray, Source
from ..runtimes.reference.model import ReferenceModel
from ..runtimes.reference.sampler import Carried
from .calls import Calls, Selector


class Executor:
    """Runs plans without gradients.

    Args:
        artifact: the policy.
        streams: how many streams go through the loop at once, about.

    Attributes:
        correction: of the sampler's steps, for all that is run but ``run_dense``; None for none.
        model: of the policy.
        selector: takes calls apart.
        types: of each block's residual.
        axes: of the streams in each block's residual.
        alike: whether all blocks have residuals of one type.
        pruner_graph: the pruner; None if the artifact has none.
    """

    def __init__(self, artifact: Artifact, streams: int = 256) -> None:
        blocks = artifact.manifest.blocks
        self.model = ReferenceModel.from_artifact(artifact)
        self.selector = Selector(graph for name, graph in artifact.graphs.items() if name in ("condition", "step"))
        self.types = [block.type for block in blocks]
        self.axes = [block.type.batch_axis or 0 for block in blocks]
        self.alike = len({block.type for block in blocks}) == 1
        self.pruner_graph = artifact.graphs.get("pruner")
        self._streams = streams
        self.correction: Correction | None = None

    def corrected(self, correction: Correction | None) -> Executor:
        """The same executor with another correction, or none."""
        other = copy(self)
        other.correction = correction
        return other

    def run(self, plans: Sequence[PlanArray] | PlanArray, calls: Calls) -> Tensor:
        """The denoised samples of every plan on every call.

        Args:
            plans: ``[C, K, blocks]``, legal without a rollout cache.
            calls: N of them.

        Returns:
            ``[C, N, T, D]``.

        Raises:
            IllegalPlanError: a plan reads the rollout cache, or step 0 is not dense.
        """
        stacked = np.stack(list(plans))
        self._check(stacked)
        rows = max(1, self._streams // calls.count)
        parts = []
        with torch.no_grad():
            for group in (stacked[i : i + rows] for i in range(0, len(stacked), rows)):
                many = self.selector.calls(calls, np.tile(np.arange(calls.count), len(group)))
                samples = self._loop(group, many)
                parts.append(samples.reshape(len(group), calls.count, *samples.shape[1:]))
        return torch.cat(parts)

    def run_each(self, plans: PlanArray, calls: Calls) -> Tensor:
        """The denoised sample of every call with a plan of its own.

        Args:
            plans: ``[N, K, blocks]``, legal without a rollout cache.
            calls: N of them.

        Returns:
            ``[N, T, D]``.

        Raises:
            IllegalPlanError: see ``run``.
        """
        self._check(plans)
        parts = [np.arange(i, min(i + self._streams, len(plans))) for i in range(0, len(plans), self._streams)]
        with torch.no_grad():
            return torch.cat([self._loop(plans[p], self.selector.calls(calls, p)) for p in parts])

    def run_dense(self, calls: Calls) -> Tensor:
        """What the dense policy answers, and how it gets there: the sample after each step, ``[N, K, T, D]``."""
        path: list[Tensor] = []
        with torch.no_grad():
            dense = np.zeros((1, self.model.steps, self.model.blocks), np.int8)
            self.corrected(None)._loop(dense, calls, path)
        return torch.stack(path, 1)

    def logits(self, calls: Calls, weights: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.float32]:
        """What the pruner says with these constants, ``[N, K, blocks, 4]``."""
        tensors = {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
        with torch.no_grad():
            return np.asarray(self.model.logits(calls.contexts, tensors).numpy(), dtype=np.float32)

    @staticmethod
    def _check(plans: PlanArray) -> None:
        if (plans == Source.ROLLOUT).any() or (plans[:, 0] != Source.COMPUTE).any():
            raise IllegalPlanError("expected plans with a dense step 0 that read nothing of an earlier call.")

    def _loop(self, plans: PlanArray, calls: Calls, path: list[Tensor] | None = None) -> Tensor:
        """All steps of streams, plan by plan; the sample after each goes to ``path``."""
        state, carried = self.begin(calls, len(plans)), self.model.begin(calls.initial)
        total: Tensor | None = None  # what all blocks add together, as long as nothing is computed
        previous: PlanArray | None = None
        for k in range(self.model.steps):
            row = plans[:, k]
            stem = self.model.stem(carried.sample, k, calls.contexts)
            if total is not None and previous is not None and np.array_equal(row, previous):
                stream = stem + total
            else:
                stream = self.step(row, k, stem, calls, state)
                computes = bool((row == Source.COMPUTE).any())
                total = None if computes or not self.alike else stream - stem
                previous = None if computes else row
            prediction = self.model.tail(stream, k, calls.contexts)
            carried = self.advance(carried, prediction, calls, k)
            if path is not None:
                path.append(carried.sample)
        return carried.sample

    def begin(self, calls: Calls, plans: int) -> State:
        """The caches before step 0; ``calls`` are those of all plans."""
        return State(calls, plans, len(self.axes))

    def advance(self, carried: Carried, prediction: Tensor, calls: Calls, k: int) -> Carried:
        """What the sampler carries to step k + 1."""
        noise = None if calls.noise is None else calls.noise[k]
        return self.model.advance(carried, prediction, noise, k, self.correction)

    def step(self, row: PlanArray, k: int, stream: Tensor, calls: Calls, state: State) -> Tensor:
        """All blocks of one step, where ``row [C, blocks]`` says what each plan does."""
        for b, axis in enumerate(self.axes):
            group, column = self.model.groups[b], row[:, b]
            computing, forwarding = column == Source.COMPUTE, column == Source.FORWARD
            if computing.all():
                residual = self.model.block(b, k, stream, calls.contexts)
                state.timestep[b] = state.forward[group] = residual
            else:
                residual = state.reused(b, group, forwarding, axis)
                if computing.any():
                    streams = state.streams(computing)
                    part = self.model.block(b, k, stream, calls.contexts, streams.tolist())
                    residual = residual.index_copy(axis, streams, part)
                    state.write(b, group, axis, streams, part)
            stream = stream + residual
        return stream


class State:
    """Caches of ``plans x calls`` streams."""

    def __init__(self, calls: Calls, plans: int, blocks: int) -> None:
        self._plans, self._each = plans, calls.count // plans
        self.forward: dict[int, Tensor] = {}
        self.timestep: list[Tensor | None] = [None] * blocks

    def streams(self, plans: BoolArray) -> Tensor:
        """Numbers of the streams of these plans."""
        return torch.from_numpy(np.flatnonzero(np.repeat(plans, self._each)))

    def reused(self, b: int, group: int, forwarding: BoolArray, axis: int) -> Tensor:
        """What block b adds where it is not computed."""
        own, other = self.timestep[b], self.forward[group]
        assert own is not None  # step 0 is dense
        if not forwarding.any():
            return own
        if forwarding.all():
            return other
        streams = self.streams(forwarding)
        return own.index_copy(axis, streams, other.index_select(axis, streams))

    def write(self, b: int, group: int, axis: int, streams: Tensor, residual: Tensor) -> None:
        """Put computed residuals of some streams into the caches."""
        own = self.timestep[b]
        assert own is not None
        self.timestep[b] = own.index_copy(axis, streams, residual)
        self.forward[group] = self.forward[group].index_copy(axis, streams, residual)
