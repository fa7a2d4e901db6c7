"""Plans on many calls at once: the meaning of the reference runtime.

A search tries thousands of plans, on calls that go through the loop together; a step in which nothing is computed costs
one addition. Consecutive calls of an episode (``Calls.window``) go through it together, too: what a call reads of an
earlier one is a residual of the same step and the same block, so that it is there when the block has been computed for
all calls. Tests hold this against ``ReferenceModel.denoise``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..artifact.view import View
from ..core.coercion import Arrays
from ..core.correction import Correction
from ..core.lattice import BoolArray, PlanArray, Source, dense_plan
from ..errors import IllegalPlanError
from ..runtimes.reference.model import Blocks, Contexts, ReferenceModel
from .calls import Calls, IntArray

STREAMS = 256
"""Calls with plans of their own that go through the loop at once."""


class Runner:
    """Runs plans without gradients.

    Args:
        view: of the policy; its precision and tokens are left alone: all is in fp32.
        device: where the network computes; None for the CPU. Samples are on the CPU, and so is all that is returned but
            streams and residuals.

    Attributes:
        correction: of the sampler's steps, for all that is run but ``run_dense``; None for none.
        types: of each block's residual, and ``axes``: of the streams in it.
        alike: whether all blocks have residuals of one type, so that one tensor can hold their sum.
    """

    def __init__(self, view: View, device: torch.device | None = None) -> None:
        blocks, pieces = view.manifest.blocks, view.pieces
        self.view = view
        self.model = ReferenceModel.from_view(view, device)
        types = pieces.conditions
        self._context_axes = {name: one.batch_axis for name, one in types.items() if one.batch_axis is not None}
        self.types = [block.type for block in blocks]
        self.axes = [block.type.batch_axis or 0 for block in blocks]
        self.alike = len({block.type for block in blocks}) == 1
        self.correction: Correction | None = None
        self._dense = dense_plan(self.model.steps, self.model.blocks)[None]

    def corrected(self, correction: Correction | None) -> Runner:
        """The same runner with another correction, or none."""
        other = copy(self)
        other.correction = correction
        return other

    def select(self, calls: Calls, streams: Sequence[int] | IntArray, *, consecutive: bool = False) -> Calls:
        """These calls, in this order; a call may be taken several times.

        They are windows still if whole windows were taken; else they are independent of each other. If they follow each
        other, ``consecutive`` makes them views of what the prologue gave: a language model's is megabytes a call. Views
        are for this process alone, since to pickle one is to pickle all.
        """
        chosen_calls = np.asarray(streams, dtype=np.int64)
        index = torch.as_tensor(chosen_calls)
        there = index.to(self.model.device)
        condition = dict(calls.contexts.condition)
        for name in self._context_axes.keys() & condition:
            own, axis = condition[name], self._context_axes[name]
            if consecutive:
                condition[name] = own.narrow(axis, int(chosen_calls[0]), len(index))
            else:
                condition[name] = own.index_select(axis, there)
        return Calls(
            contexts=Contexts(len(index), condition),
            initial=calls.initial[index],
            noise=None if calls.noise is None else calls.noise[:, index],
            episodes=calls.episodes[index.numpy()],
            path=None if calls.path is None else calls.path[index],
            window=calls.window if whole_windows(chosen_calls, calls.window) else 1,
            known=calls.known and replace(calls.known, values=calls.known.values[:, chosen_calls]),
        )

    def run(self, plan: PlanArray, calls: Calls) -> Tensor:
        """The denoised sample of every call, ``[N, T, D]``, with one plan, or with its own of ``[N, K, blocks]``.

        A cell that reads of an earlier call what no earlier one of its window computed reads TIMESTEP. Raises
        IllegalPlanError: a plan reads the rollout cache and calls are independent, or step 0 is not dense.
        """
        if (plan[..., 0, :] != Source.COMPUTE).any():
            raise IllegalPlanError("expected plans with a dense step 0.")
        if calls.window == 1 and (plan == Source.ROLLOUT).any():
            raise IllegalPlanError("expected consecutive calls, or plans that read nothing of an earlier call.")
        with torch.no_grad():
            if plan.ndim == 2:
                return last(self._following(plan[None], calls))
            parts = calls.parts(STREAMS)
            return torch.cat([last(self._following(plan[part], self.select(calls, part))) for part in parts])

    def run_dense(self, calls: Calls) -> Tensor:
        """What the dense policy answers, and how it gets there: the sample after each step, ``[N, K, T, D]``."""
        with torch.no_grad():
            return torch.stack(list(self.corrected(None)._following(self._dense, calls)), 1)

    def logits(self, calls: Calls, weights: Arrays) -> npt.NDArray[np.float32]:
        """What the pruner says with these constants, ``[N, K, blocks, 4]``."""
        tensors = {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
        with torch.no_grad():
            return np.asarray(self.model.logits(calls.contexts, tensors).numpy(), dtype=np.float32)

    def samples(self, calls: Calls, blocks: Blocks) -> Iterator[Tensor]:
        """The sample ``[N, T, D]`` after each step; ``blocks`` says what the blocks make of the stem's stream."""
        loop = self.model.steps_of(calls.contexts, calls.initial, calls.noise, blocks, self.correction, calls.known)
        return (carried.sample for carried in loop)

    def _following(self, plans: PlanArray, calls: Calls) -> Iterator[Tensor]:
        """``samples`` of blocks that follow one plan for all calls, or one for each: ``[1 or N, K, blocks]``."""
        caches = StreamCaches()
        total: Tensor | None = None  # what all blocks add together, as long as nothing is computed
        previous: PlanArray | None = None

        def blocks(k: int, stem: Tensor) -> Tensor:
            nonlocal total, previous
            row = plans[:, k]
            if total is not None and previous is not None and np.array_equal(row, previous):
                return stem + total
            stream = self.step(row, k, stem, calls, caches)
            computes = bool((row == Source.COMPUTE).any())
            total = None if computes or not self.alike else stream - stem
            previous = None if computes else row
            return stream

        return self.samples(calls, blocks)

    def step(
        self, row: PlanArray, k: int, stream: Tensor, calls: Calls, caches: StreamCaches, blocks: range | None = None
    ) -> Tensor:
        """The residual stream after the blocks of step k, where ``row [1, blocks]`` or ``[N, blocks]`` says what to do.

        ``stream`` is that before the blocks, all of them or those that are given; ``caches`` are changed.
        """
        for b in range(self.model.blocks) if blocks is None else blocks:
            group, column, axis = self.model.groups[b], row[:, b], self.axes[b]
            computing, forwarding = column == Source.COMPUTE, column == Source.FORWARD
            if computing.all():
                residual = self.model.block(b, k, stream, calls.contexts)
                caches.timestep[b] = caches.forward[group] = residual
            else:
                residual = caches.reused(b, group, forwarding, axis)
                if computing.any():
                    streams = _numbers(computing, stream)
                    part = self.model.block(b, k, stream, calls.contexts, streams.tolist())
                    residual = residual.index_copy(axis, streams, part)
                    caches.write(b, group, axis, streams, part)
                    reading, read = rollout_reads(column, calls.window)
                    if len(reading):
                        there = torch.from_numpy(np.stack([reading, read])).to(stream.device)
                        residual = residual.index_copy(axis, there[0], residual.index_select(axis, there[1]))
            stream = stream + residual
        return stream


class StreamCaches:
    """Caches of all streams; what step 0 has to write is there after it, since it is dense."""

    def __init__(self) -> None:
        self.forward: dict[int, Tensor] = {}  # by group
        self.timestep: dict[int, Tensor] = {}  # by block

    def copy(self) -> StreamCaches:
        """Another one with the same residuals; what is written to one of the two is not written to the other."""
        other = StreamCaches()
        other.forward, other.timestep = dict(self.forward), dict(self.timestep)
        return other

    def reused(self, b: int, group: int, forwarding: BoolArray, axis: int) -> Tensor:
        """What block b adds where it is not computed."""
        own, other = self.timestep[b], self.forward[group]
        if not forwarding.any():
            return own
        if forwarding.all():
            return other
        streams = _numbers(forwarding, own)
        return own.index_copy(axis, streams, other.index_select(axis, streams))

    def write(self, b: int, group: int, axis: int, streams: Tensor, residual: Tensor) -> None:
        """Put computed residuals of some streams into the caches."""
        self.timestep[b] = self.timestep[b].index_copy(axis, streams, residual)
        self.forward[group] = self.forward[group].index_copy(axis, streams, residual)


def rollout_reads(column: PlanArray, window: int) -> tuple[IntArray, IntArray]:
    """Which calls read ROLLOUT in a cell, and from which call each: from the last before it that computed the cell.

    Args:
        column: ``[N]``, the cell of each call's plan; or ``[1]`` for all calls, of which none then reads another.
        window: consecutive calls.

    Returns:
        Numbers of calls, twice ``[n]``. A call whose cell no earlier one of its window computed is not among them.
    """
    if len(column) % window or not (column == Source.ROLLOUT).any():
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    latest = latest_before(column, window)
    reading = np.flatnonzero((column == Source.ROLLOUT) & (latest >= 0))
    return reading, latest[reading]


def latest_before(cells: PlanArray, window: int) -> IntArray:
    """For each call the last one before it, in its window, that computed a cell; -1 where none did: ``[N, ...]``."""
    numbers = np.arange(len(cells)).reshape(-1, *[1] * (cells.ndim - 1))
    computed = np.where(cells == Source.COMPUTE, numbers, -1).reshape(-1, window, *cells.shape[1:])
    before = np.full_like(computed, -1)
    before[:, 1:] = np.maximum.accumulate(computed, axis=1)[:, :-1]
    return before.reshape(cells.shape)


def whole_windows(numbers: IntArray, window: int) -> bool:
    """Whether numbers of calls are those of whole windows, in order."""
    if window == 1 or len(numbers) % window:
        return False
    rows = numbers.reshape(-1, window)
    return bool((rows[:, :1] % window == 0).all() and (rows == rows[:, :1] + np.arange(window)).all())


def last(samples: Iterable[Tensor]) -> Tensor:
    """The denoised sample: that after the last step."""
    return deque(samples, maxlen=1).pop()


def _numbers(streams: BoolArray, beside: Tensor) -> Tensor:
    """Numbers of those streams that are True, on the device of a tensor."""
    return torch.from_numpy(np.flatnonzero(streams)).to(beside.device)
