"""What a gate is worth: sparse calls and the gradient of their error in every gate, as the paper has it.

A cell adds ``g0 computed + g1 forward + g2 timestep + g3 rollout``, of which one gate is 1. Residuals in caches are
detached, as in the authors' code. So the gradient of a gate is the product of what it would add and the gradient
of the residual stream behind the cell, and the gates need not be in torch's graph: only blocks that are computed are,
with the stem, the tail and the sampler. Where nothing is computed a step costs two small products.

What a block would compute in a cell that does not compute it comes from the dense call with the same noise, as in
``ttscompile.calibration.pruner.straight_through``. The authors compute it on the sparse stream, which is more work than
all the rest: ``sparse_stream`` does that, too.
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
from ttscompile.runtimes.reference.model import Contexts

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
        before: the stream before each block, ``[N, blocks, size]``, where somebody asks for it.
        computed: what the block computed, for the calls ``takers``; None where none did.
    """

    k: int
    first: int
    end: int
    passed: Tensor
    timestep: Tensor
    forward: Tensor
    before: Tensor | None = None
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
        sparse_stream: whether what a cell would have computed is computed, where the sparse call was; as theirs is.
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
        sparse_stream: bool = False,
        at_once: int = 64,
    ) -> None:
        if not runner.alike:
            raise CalibrationError("expected blocks whose residuals have one shape; found several. Take 'tts-paper'.")
        self.runner, self.calls, self.sources = runner, calls, sources
        self.through_caches, self.sparse_stream = through_caches, sparse_stream
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

        The first calls of windows are not run if they compute everything: what they compute is known.

        Args:
            plans: legal, int8 ``[N, K, blocks]``, step 0 dense.
            numbers: of N of the calls, whole windows.
            loss: of the samples after each step, ``[n, T, D]`` each, of the calls that are run.

        Returns:
            The loss, and its gradient in every gate, ``[N, K, blocks, 4]``; 0 at step 0, where nothing was written, and
            in calls that are not run.
        """
        window = self.runner.select(self.calls, numbers).window
        written, there = latest_before(plans, window), np.arange(len(numbers))
        if window > 1 and (plans[::window] == Source.COMPUTE).all():
            there = there[there % window > 0]
        calls = self.runner.select(self.calls, numbers[there])
        calls.initial.requires_grad_()
        trail = _Trail(self, plans, calls, numbers, there, written[there])
        value = loss(list(self.runner.samples(calls, trail.blocks)), calls)
        behind = torch.autograd.grad(value, [span.passed for span in trail.spans])
        gates = torch.zeros(*plans.shape, SOURCES)
        gates[torch.from_numpy(there)] = trail.gates(behind)
        return float(value.detach()), gates

    def dense(self, k: int, numbers: Tensor, first: int, end: int) -> Tensor:
        """What blocks compute in dense calls, bfloat16 ``[N, blocks, size]``; numbers: ``[N]`` or ``[N, blocks]``."""
        if numbers.ndim == 2:
            return self._dense[k, numbers, torch.arange(first, end)]
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
    """One run of sparse calls: what is in the caches, and what was.

    Args:
        of: whose calls they are.
        plans: of all N calls.
        calls: those that are run.
        numbers: of all N calls, among those of ``of``.
        there: which of the N are run; the others are dense.
        written: which of the N last computed a cell before each of these; -1 where none did.
    """

    def __init__(
        self, of: GateGradients, plans: PlanArray, calls: Calls, numbers: IntArray, there: IntArray, written: IntArray
    ) -> None:
        self._of, self._plans, self._calls = of, plans[there], calls
        self._all, self._numbers = torch.from_numpy(numbers), torch.from_numpy(numbers[there])
        self._row = np.full(len(numbers), -1)
        self._row[there] = np.arange(len(there))
        model = of.runner.model
        self._groups = torch.tensor(model.groups)
        self._timestep = list[Tensor]()
        self._forward = dict[int, Tensor]()
        self._stacked: tuple[Tensor, Tensor] | None = None
        self._written = written
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
        added, some = timestep, row[:, first:end]
        if (taking := some == Source.FORWARD).any():
            added = torch.where(torch.from_numpy(taking)[..., None], forward, added)
        if (taking := some == Source.ROLLOUT).any():
            added = torch.where(torch.from_numpy(taking)[..., None], self._earlier(k, first, end, taking), added)
        before = None
        if self._of.sparse_stream:
            before = self._of.rows(stream)[:, None] + added.cumsum(1) - added
        stream = stream + self._of.residual(added.sum(1))
        self.spans.append(Span(k, first, end, stream, timestep, forward, before))
        return stream

    def _earlier(self, k: int, first: int, end: int, asking: npt.NDArray[np.bool_]) -> Tensor:
        """What the last earlier call of the window that computed a cell had, ``[N, blocks, size]``, for who asks."""
        latest = self._written[:, k, first:end]
        known = np.maximum(latest, 0)
        found = self._of.dense(k, self._all[torch.from_numpy(known)], first, end).float()
        for n, b in np.argwhere(asking & (latest >= 0) & (self._row[known] >= 0)).tolist():
            found[n, b] = self._computed[k, first + b][self._row[latest[n, b]]]
        return found

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
            self._computed[k, b] = computed = torch.zeros_like(timestep).index_copy(0, there, rows)
            if (taking := column[:, None] == Source.ROLLOUT).any():
                added = torch.where(torch.from_numpy(taking), self._earlier(k, b, b + 1, taking)[:, 0], added)
            residual = of.residual(added).index_copy(axis, there, part)
            self._timestep[b] = timestep.index_copy(0, there, rows)
            self._forward[group] = forward.index_copy(0, there, rows)
        if everyone:
            self._timestep[b] = self._forward[group] = rows
        self._computed[k, b], self._stacked = computed, None
        before = of.rows(stream)[:, None] if of.sparse_stream else None
        stream = stream + residual
        self.spans.append(Span(k, b, b + 1, stream, timestep[:, None], forward[:, None], before, rows, takers))
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
        fresh = self._on_the_way() if self._of.sparse_stream else None
        for span, gradient in zip(self.spans, behind, strict=True):
            rows, at = self._of.rows(gradient)[:, :, None], (slice(None), span.k, slice(span.first, span.end))
            if fresh is None:
                candidates = self._of.dense(span.k, self._numbers, span.first, span.end)
            else:
                candidates = fresh[span.k, :, span.first : span.end]
            found[(*at, Source.COMPUTE)] = (candidates @ rows.to(candidates.dtype))[..., 0].float()
            if span.computed is not None and span.takers is not None:
                own = torch.from_numpy(span.takers)
                found[own, span.k, span.first, Source.COMPUTE] = (span.computed * rows[own, :, 0]).sum(1)
            found[(*at, Source.TIMESTEP)] = (span.timestep @ rows)[..., 0]
            if Source.FORWARD in self._of.sources:
                found[(*at, Source.FORWARD)] = (span.forward @ rows)[..., 0]
            latest = self._written[:, span.k, span.first : span.end]
            if Source.ROLLOUT in self._of.sources and (latest >= 0).any():
                read = self._earlier(span.k, span.first, span.end, np.ones_like(latest, np.bool_))
                found[(*at, Source.ROLLOUT)] = (read @ rows)[..., 0] * torch.from_numpy(latest >= 0)
        if self._of.through_caches:
            self._add_later(found, behind)
        return found

    def _on_the_way(self) -> Tensor:
        """What blocks compute, or would compute, where the sparse calls were, bfloat16 ``[K, N, blocks, size]``."""
        of, model, streams = self._of, self._of.runner.model, self._calls.count
        found = torch.zeros_like(of.dense(0, self._numbers, 0, model.blocks)).repeat(model.steps, 1, 1, 1)
        found = found.reshape(model.steps, streams, model.blocks, -1)
        for b, piece in enumerate(of.runner.view.pieces.blocks):
            places = [
                (span.k, span.before[:, b - span.first])
                for span in self.spans
                if span.first <= b < span.end and span.before is not None
            ]
            at_once = len(places) if not piece.contexts else 1  # who reads the step's time has one step at once
            for begin in range(0, len(places), max(1, at_once)):
                some = places[begin : begin + at_once]
                contexts = self._calls.contexts if piece.contexts else Contexts(len(some) * streams, {})
                with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
                    made = model.block(b, some[0][0], of.residual(torch.cat([one for _, one in some])), contexts)
                rows = of.rows(made).reshape(len(some), streams, -1)
                found[[k for k, _ in some], :, b] = rows.to(found.dtype)
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
