"""What of a step is no block: the sampler and its correction, as one product of matrices; and steps without any block.

``core.update`` has the formula of the former, and ``ir.idle_form`` says what the latter compute, where the network
allows it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ttscompile.core.correction import HISTORY, Correction, no_correction
from ttscompile.core.spec import PolicySpec
from ttscompile.core.update import clip_of, matrices
from ttscompile.ir.idle_form import IdleForm

from . import devices


class State(NamedTuple):
    """What the loop carries from one step to the next.

    Attributes:
        sample: ``[D, B, T]``, contiguous.
        history: of the correction, ``[D, B, 4 T]``.
        memory: the sampler's S memories, ``[D, B, S T]``.
    """

    sample: Tensor
    history: Tensor
    memory: Tensor


class Advance(devices.OnTensors):
    """The steps of a policy's sampler with one correction.

    Attributes:
        updates: the matrices, ``[K, G, R, (1 + S) T]``.
        horizon: T.
        dimensions: D.
        memories: S.
        reading: ``[N, F]``, what the correction reads of the condition; None if it reads nothing.
        observed: ``[F, K D T]``, what that adds; None if it reads nothing.
        jumps: by anchor, the number of its jump, and the step after which that is added.
        anchors: which steps are.
        clip: of denoised samples; None where the sampler does not clip them.
        to_clean: ``[K, 2]``, what a denoised sample is of the sample and of the prediction.
    """

    TENSORS: tuple[str, ...] = ("updates", "to_clean", "reading", "observed", "inner", "middle", "outer")

    def __init__(self, spec: PolicySpec, correction: Correction | None, device: torch.device) -> None:
        table, (self.horizon, self.dimensions) = spec.sampler, spec.sample
        self.memories, self.steps = table.memories, table.steps
        used = correction or no_correction(table.steps, spec.sample)
        self.anchors: list[bool] = used.anchors.tolist()
        self.updates = devices.placed(matrices(table, used), device)
        self._of_step = [one.expand(self.dimensions, -1, -1) for one in self.updates]
        self.clip = clip_of(table)
        self._to_clean = list(zip(table.sample_to_x0.tolist(), table.out_to_x0.tolist(), strict=True))
        self.to_clean = torch.tensor(self._to_clean, dtype=torch.float32, device=device)
        self.reading = self.observed = self.inner = self.middle = self.outer = None
        if correction is not None and correction.reads:
            self.reading = devices.placed(correction.reading, device)
            self.observed = devices.placed(correction.observed.reshape(correction.reads, -1), device)
        if used.jumps:
            layers = used.inner, used.middle, used.outer
            self.inner, self.middle, self.outer = (devices.placed(array, device) for array in layers)
        self.jumps = used.jumps

    @property
    def layers(self) -> tuple[Tensor, ...]:
        """Inner, middle and outer of its jumps; none if it has none."""
        return tuple(each for each in (self.inner, self.middle, self.outer) if each is not None)

    def on(self, tensors: Mapping[str, Tensor]) -> Advance:
        """See ``OnTensors.on``."""
        other = super().on(tensors)
        other._of_step = [one.expand(len(each), -1, -1) for one, each in zip(other.updates, self._of_step, strict=True)]
        return other

    def of_condition(self, condition: Tensor) -> tuple[Tensor, Tensor]:
        """What the correction reads, ``[B, F]``, and what that adds to the sample of every step, ``[K, D, B, T]``.

        Args:
            condition: ``[B, N]``.
        """
        assert self.reading is not None and self.observed is not None
        read = condition @ self.reading
        added = (read @ self.observed).reshape(len(condition), self.steps, -1, self.horizon)
        return read, added.permute(1, 2, 0, 3)

    def jump(self, layers: Sequence[Tensor], read: Tensor | None, history: Tensor) -> Tensor:
        """What a jump adds, ``[D, B, T]``.

        Args:
            layers: its own of ``layers``.
            read: of the condition, ``[B, F]``; None if nothing is.
            history: after its anchor, ``[D, B, 4 T]``.
        """
        dimensions, streams, _ = history.shape
        value = history.permute(1, 0, 2).reshape(streams, -1)
        value = value if read is None else torch.cat([read, value], 1)
        *hidden, outer = layers
        for layer in hidden:
            value = torch.addmm(layer[-1], value, layer[:-1]).relu()
        added = torch.addmm(outer[-1], value, outer[:-1])
        return added.reshape(streams, dimensions, self.horizon).permute(1, 0, 2)

    def __call__(self, state: State, prediction: Tensor, k: int, offset: Tensor) -> State:
        """What is carried to step k + 1, of ``prediction [D, B, T]`` and ``offset [D, B, (1 + S) T]``."""
        clean = None
        if self.clip is not None:
            of_sample, of_prediction = self._to_clean[k]
            clean = (state.sample * of_sample).add_(prediction, alpha=of_prediction).clamp_(-self.clip, self.clip)
        moved = self._moved(state, prediction, clean, self._of_step[k], offset)
        return moved._replace(history=self._longer(state, prediction)) if self.anchors[k] else moved

    def _moved(self, state: State, prediction: Tensor, clean: Tensor | None, matrix: Tensor, offset: Tensor) -> State:
        sample, history, memory = state
        read = [sample, prediction, history, *([] if clean is None else [clean]), *[memory] * bool(self.memories)]
        following = torch.baddbmm(offset, torch.cat(read, 2), matrix)
        if self.memories:
            memory, following = following[..., self.horizon :], following[..., : self.horizon].contiguous()
        return State(following, history, memory)

    def _longer(self, state: State, prediction: Tensor) -> Tensor:
        return torch.cat([state.sample, prediction, state.history[..., : 2 * self.horizon]], 2)


def begin(initial: Tensor, advance: Advance) -> State:
    """What is carried to step 0: the sample ``[B, T, D]``, and zeros."""
    sample = initial.permute(2, 0, 1).contiguous()
    dimensions, streams, horizon = sample.shape
    history = sample.new_zeros(dimensions, streams, HISTORY * horizon)
    return State(sample, history, sample.new_zeros(dimensions, streams, advance.memories * horizon))


class Prepared(NamedTuple):
    """What the total of idle steps decides.

    Attributes:
        rows: of y, ``[D + 1, B T]``.
        numerator: ``[D, B T]``.
        shift: ``[D, B T]``, what is added to the quotient.
    """

    rows: Tensor
    numerator: Tensor
    shift: Tensor


class IdleSteps(devices.OnTensors):
    """What steps that add one sum of residuals predict, from numbers of the size of the sample."""

    TENSORS = ("constant", "head", "shift", "along", "across", "basis")

    def __init__(self, form: IdleForm, device: torch.device) -> None:
        def there(array: object) -> Tensor:
            return devices.placed(np.asarray(array, np.float32), device)

        self._turned, self._eps = form.turned, form.eps
        self.constant, self.head, self.shift = there(form.constant), there(form.head), there(form.shift)
        self._dimensions = form.head.shape[1]
        product = there(form.product)
        self.along, self.across = product[: self._dimensions + 1], product[self._dimensions + 1 :]
        self._held = not form.product.any()  # the prediction is the total's, whatever the sample is
        self.basis = None if form.basis is None else there(form.basis)
        self.fused: Any = None  # the module of that name, where there are a GPU and Triton

    def prepare(self, total: Tensor) -> Prepared:
        """What is known as soon as the total is."""
        hidden = (total.transpose(0, 1) if self._turned else total) + self.constant
        if self.basis is None:
            numerator = hidden @ self.head
            blank = torch.zeros_like(numerator)
            rows = torch.cat([blank, torch.ones_like(blank[..., :1])], 2)
        else:
            width = hidden.shape[2]
            centred = hidden - hidden.mean(2, keepdim=True)
            along = centred @ self.basis
            across = centred - along @ self.basis.T
            deviation = ((across * across).sum(2, keepdim=True) / width + self._eps).sqrt()
            rows, numerator = torch.cat([along / width**0.5, deviation], 2), centred @ self.head
        shift = self.shift.expand(-1, len(hidden), -1)
        return Prepared(rows.permute(2, 0, 1).flatten(1), numerator.permute(2, 0, 1).flatten(1), shift.flatten(1))

    def predict(self, known: Prepared, sample: Tensor) -> Tensor:
        """The prediction ``[D, B, T]`` for the sample ``[D, B, T]``, contiguous."""
        rows, numerator, shift = known
        if not self._held:
            flat = sample.view(self._dimensions, -1)
            rows = torch.addmm(rows, self.along, flat)
            numerator = torch.addmm(numerator, self.across, flat)
        return torch.addcdiv(shift, numerator, torch.linalg.vector_norm(rows, dim=0)).view(sample.shape)
