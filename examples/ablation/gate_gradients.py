"""What a gate is worth: sparse calls and the gradient of their error in every gate, as the paper has it.

A cell adds ``g0 computed + g1 forward + g2 timestep + g3 rollout``, of which one gate is 1. Residuals in caches are
detached, as in the authors' code. So the gradient of a gate is the product of what it would add and the gradient
of the residual stream behind the cell, and the gates need not be in torch's graph: only blocks that are computed are,
with the stem, the tail and the sampler. Where nothing is computed a step costs two small products.

What a block would compute in a cell that does not compute it comes from the dense call with the same noise, as in
``ttscompile.calibration.pruner.straight_through``; the authors compute it on the sparse stream, twenty times the work.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ttscompile.calibration.calls import Calls
from ttscompile.calibration.runner import Runner, StreamCaches, latest_before
from ttscompile.core.lattice import PlanArray, Source
from ttscompile.errors import CalibrationError

IntArray = npt.NDArray[np.int64]

SOURCES = len(Source)


@dataclass
class Span:
    """Cells of a step behind which the residual stream has one gradient.

    Attributes:
        k: the step; ``first`` and ``end`` are those of its blocks.
        passed: the stream behind them.
        timestep: what each block of the span had in its cache, ``[N, blocks, size]``.
        forward: the same of each block's kind.
        computed: what the block computed, for the calls ``takers``; None where none did.
    """

    k: int
    first: int
    end: int
    passed: Tensor
    timestep: Tensor
    forward: Tensor
    computed: Tensor | None = None
    takers: IntArray | None = None


class GateGradients:
    """Calls to learn from, in windows of consecutive ones, and what blocks compute in them when all is computed.

    Args:
        runner: its correction is that of the sparse calls.
        calls: with what the dense policy answers.
        sources: what cells may read; TIMESTEP always.
        through_caches: whether a gate of COMPUTE also has the part of what later cells of its call read of it. The
            authors' have not.
        at_once: calls that go through the dense loop together.

    Raises:
        CalibrationError: residuals of blocks differ in shape.
    """

    def __init__(
        self,
        runner: Runner,
        calls: Calls,
        sources: Collection[Source] = tuple(Source),
        through_caches: bool = False,
        at_once: int = 64,
    ) -> None:
        if not runner.alike:
            raise CalibrationError("expected blocks whose residuals have one shape; found several. Take 'tts-paper'.")
        self.runner, self.calls, self.sources, self.through_caches = runner, calls, sources, through_caches
        model, size = runner.model, math.prod(runner.types[0].at(1))
        self._axis, self._shape = runner.axes[0], runner.types[0]
        self._dense = torch.empty(model.steps, calls.count, model.blocks, size, dtype=torch.bfloat16)
        whole = np.full((1, model.blocks), Source.COMPUTE, np.int8)
        for numbers in calls.parts(at_once):
            some, caches = runner.select(calls, numbers), StreamCaches()

            def blocks(
                k: int, stem: Tensor, some: Calls = some, caches: StreamCaches = caches, numbers: IntArray = numbers
            ) -> Tensor:
                stream = runner.step(whole, k, stem, some, caches)
                for b in range(model.blocks):
                    self._dense[k, numbers, b] = self._rows(caches.timestep[b]).to(torch.bfloat16)
                return stream

            with torch.no_grad():
                for _ in runner.corrected(None).samples(some, blocks):
                    pass

    def __call__(
        self, plans: PlanArray, numbers: IntArray, loss: Callable[[Sequence[Tensor], Calls], Tensor]
    ) -> tuple[float, Tensor]:
        """Run sparse calls, and go back from their loss.

        Args:
            plans: legal, int8 ``[N, K, blocks]``, step 0 dense.
            numbers: of N of the calls, whole windows.
            loss: of the samples after each step, ``[N, T, D]`` each, of these calls.

        Returns:
            The loss, and its gradient in every gate, ``[N, K, blocks, 4]``; 0 at step 0, and where nothing was written.
        """
        calls = self.runner.select(self.calls, numbers)
        calls.initial.requires_grad_()
        trail = _Trail(self, plans, calls, numbers)
        value = loss(list(self.runner.samples(calls, trail.blocks)), calls)
        behind = torch.autograd.grad(value, [span.passed for span in trail.spans])
        return float(value.detach()), trail.gates(behind)

    def dense(self, k: int, numbers: Tensor, first: int, end: int) -> Tensor:
        """What blocks compute in dense calls, bfloat16 ``[N, blocks, size]``."""
        return self._dense[k, numbers, first:end]

    def _rows(self, residual: Tensor) -> Tensor:
        return residual.movedim(self._axis, 0).flatten(1)

    def residual(self, rows: Tensor) -> Tensor:
        """``[N, size]`` as a residual."""
        shape = list(self._shape.at(len(rows)))
        del shape[self._axis]
        return rows.reshape(len(rows), *shape).movedim(0, self._axis)

    def rows(self, residual: Tensor) -> Tensor:
        """A residual as ``[N, size]``, without its gradient."""
        return self._rows(residual.detach())


class _Trail:
    """One run of sparse calls: what is in the caches, and what was."""

    def __init__(self, of: GateGradients, plans: PlanArray, calls: Calls, numbers: IntArray) -> None:
        self._of, self._plans, self._calls = of, plans, calls
        self._numbers = torch.from_numpy(numbers)
        model = of.runner.model
        self._groups = torch.tensor(model.groups)
        self._timestep = list[Tensor]()
        self._forward = dict[int, Tensor]()
        self._stacked: tuple[Tensor, Tensor] | None = None
        self._written = latest_before(plans, calls.window)
        self._computed = dict[tuple[int, int], Tensor]()  # of each cell that somebody computed, for all calls
        self.spans = list[Span]()

    def blocks(self, k: int, stream: Tensor) -> Tensor:
        row, model = self._plans[:, k], self._of.runner.model
        if k == 0:
            for b in range(model.blocks):
                residual = model.block(b, 0, stream, self._calls.contexts)
                stream = stream + residual
                rows = self._of.rows(residual)
                self._timestep.append(rows)
                self._forward[model.groups[b]] = rows
            return stream
        computing = (row == Source.COMPUTE).any(0)
        begin = 0
        for b in [*np.flatnonzero(computing).tolist(), model.blocks]:
            if b > begin:
                stream = self._idle(k, begin, b, row, stream)
            if b < model.blocks:
                stream = self._computing(k, b, row[:, b], stream)
            begin = b + 1
        return stream

    def _idle(self, k: int, first: int, end: int, row: PlanArray, stream: Tensor) -> Tensor:
        """Blocks that no call computes: their sum is added."""
        timestep, forward = self._caches(first, end)
        added, some = timestep.sum(1), row[:, first:end]
        if (taking := some == Source.FORWARD).any():
            added = added + ((forward - timestep) * torch.from_numpy(taking)[..., None]).sum(1)
        for n, b in np.argwhere(some == Source.ROLLOUT).tolist():
            added[n] += self._computed[k, first + b][self._written[n, k, first + b]] - timestep[n, b]
        stream = stream + self._of.residual(added)
        self.spans.append(Span(k, first, end, stream, timestep, forward))
        return stream

    def _computing(self, k: int, b: int, column: PlanArray, stream: Tensor) -> Tensor:
        of, model, axis = self._of, self._of.runner.model, self._of.runner.axes[0]
        timestep, group = self._timestep[b], model.groups[b]
        forward, takers = self._forward[group], np.flatnonzero(column == Source.COMPUTE)
        everyone = len(takers) == len(column)
        part = model.block(b, k, stream, self._calls.contexts, None if everyone else takers.tolist())
        rows = of.rows(part)
        if everyone:
            residual, computed = part, rows
        else:
            there = torch.from_numpy(takers)
            added = torch.where(torch.from_numpy(column == Source.FORWARD)[:, None], forward, timestep)
            if (column == Source.ROLLOUT).any():
                computed = torch.zeros_like(timestep).index_copy(0, there, rows)
                for n in np.flatnonzero(column == Source.ROLLOUT).tolist():
                    added = added.index_copy(0, torch.tensor([n]), computed[self._written[n, k, b]][None])
            residual = of.residual(added).index_copy(axis, there, part)
            computed = torch.zeros_like(timestep).index_copy(0, there, rows)
            self._timestep[b] = timestep.index_copy(0, there, rows)
            self._forward[group] = forward.index_copy(0, there, rows)
        if everyone:
            self._timestep[b] = self._forward[group] = rows
        self._computed[k, b], self._stacked = computed, None
        stream = stream + residual
        self.spans.append(Span(k, b, b + 1, stream, timestep[:, None], forward[:, None], rows, takers))
        return stream

    def _caches(self, first: int, end: int) -> tuple[Tensor, Tensor]:
        """What the caches hold for these blocks, ``[N, blocks, size]`` twice; the same tensors until one changes."""
        if self._stacked is None:
            groups = [self._forward[group] for group in self._of.runner.model.groups]
            self._stacked = torch.stack(self._timestep, 1), torch.stack(groups, 1)
        timestep, forward = self._stacked
        return timestep[:, first:end], forward[:, first:end]

    def gates(self, behind: tuple[Tensor, ...]) -> Tensor:
        """From the gradients of the streams behind the spans, those of the gates, ``[N, K, blocks, 4]``."""
        found = torch.zeros(*self._plans.shape, SOURCES)
        for span, gradient in zip(self.spans, behind, strict=True):
            rows, at = self._of.rows(gradient)[:, :, None], (slice(None), span.k, slice(span.first, span.end))
            candidates = self._of.dense(span.k, self._numbers, span.first, span.end)
            found[(*at, Source.COMPUTE)] = (candidates @ rows.to(candidates.dtype))[..., 0].float()
            if span.computed is not None and span.takers is not None:
                own = torch.from_numpy(span.takers)
                found[own, span.k, span.first, Source.COMPUTE] = (span.computed * rows[own, :, 0]).sum(1)
            found[(*at, Source.TIMESTEP)] = (span.timestep @ rows)[..., 0]
            if Source.FORWARD in self._of.sources:
                found[(*at, Source.FORWARD)] = (span.forward @ rows)[..., 0]
            for b in range(span.first, span.end):
                if (written := self._computed.get((span.k, b))) is not None:
                    latest = self._written[:, span.k, b]
                    has = torch.from_numpy(latest >= 0)
                    read = written[torch.from_numpy(np.maximum(latest, 0))]
                    found[:, span.k, b, Source.ROLLOUT] = (read * rows[..., 0]).sum(1) * has
        if self._of.through_caches:
            self._add_later(found, behind)
        return found

    def _add_later(self, found: Tensor, behind: tuple[Tensor, ...]) -> None:
        """Add to COMPUTE what later cells read of it: the gradients of the caches, from the last cell back.

        A cache is ``g0 computed + (1 - g0) before`` behind a cell. Where cells read it is known, and so is how long.
        """
        groups, reads = self._of.runner.model.groups, Source.FORWARD in self._of.sources
        kept = torch.zeros_like(self._timestep[0][:, None].expand(-1, len(groups), -1))
        shared = {group: torch.zeros_like(kept[:, 0]) for group in groups}
        for span, gradient in zip(reversed(self.spans), reversed(behind), strict=True):
            rows, cells = self._of.rows(gradient), slice(span.first, span.end)
            plan = torch.from_numpy(self._plans[:, span.k, cells])
            fresh = self._of.dense(span.k, self._numbers, span.first, span.end).float()
            if span.computed is not None and span.takers is not None:
                fresh[torch.from_numpy(span.takers), 0] = span.computed
            own = kept[:, cells]
            found[:, span.k, cells, Source.COMPUTE] += (own * (fresh - span.timestep)).sum(-1)
            still = (plan != Source.COMPUTE)[..., None] * own
            kept[:, cells] = still + (plan == Source.TIMESTEP)[..., None] * rows[:, None]
            for b in reversed(range(span.first, span.end)) if reads else ():
                i, of = b - span.first, shared[groups[b]]
                found[:, span.k, b, Source.COMPUTE] += (of * (fresh[:, i] - span.forward[:, i])).sum(-1)
                still = (plan[:, i] != Source.COMPUTE)[:, None] * of
                shared[groups[b]] = still + (plan[:, i] == Source.FORWARD)[:, None] * rows
