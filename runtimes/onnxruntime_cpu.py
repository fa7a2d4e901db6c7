"""The product on the CPU: numpy and onnxruntime, one session a piece, plans lowered to short lists of instructions."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ttscompile.config import FloatArray, Noise
from ttscompile.errors import IllegalPlanError
from ttscompile.lattice import BoolArray, PlanArray, Source, check_plan, require_legal

from .base import (
    GIVEN,
    PRUNER,
    CallReport,
    Timings,
    check_call,
    computed_cells,
    frozen,
    milliseconds,
    no_pruner,
    pruner_plan,
    settle_plan,
)
from .lowering import Add, Lowered, LoweringCache
from .onnxruntime_sessions import Array, open_sessions
from .workspace import Workspace

if TYPE_CHECKING:
    from ttscompile.artifact.load import Artifact


class OnnxRuntime:
    """A ``Runtime`` on onnxruntime; see ``base.Runtime``.

    Args:
        artifact: loaded and checked.
        threads: threads of arithmetic; one runs on the caller's thread.

    Raises:
        RuntimeUnavailableError: onnxruntime is missing, or other code has made its global thread pool.
        ArtifactError: onnxruntime refuses a graph.
    """

    def __init__(self, artifact: Artifact, threads: int = 1) -> None:
        self._manifest = artifact.manifest
        self._tables = artifact.tables
        self._sessions = open_sessions(artifact, threads)
        self._groups = self._manifest.groups
        self._lowering = LoweringCache(self._groups)
        self._workspace: Workspace | None = None
        self._written: BoolArray | None = None

    @property
    def streams(self) -> int | None:
        """B of the episode under way."""
        return None if self._written is None else len(self._written)

    def reset(self) -> None:
        """Forget the rollout cache; its memory is kept for the next episode."""
        self._written = None

    def predict(
        self,
        obs: Mapping[str, FloatArray],
        noise: Noise,
        plan: npt.ArrayLike | None = None,
        *,
        plan_name: str | None = None,
        repair: bool = False,
    ) -> tuple[FloatArray, CallReport]:
        """Denoise one chunk; see ``base.Runtime.predict``."""
        spec = self._manifest.spec
        streams = check_call(self.streams, noise, spec.sample, spec.sampler)
        written = self._written
        if written is None:
            written = np.zeros((streams, spec.sampler.steps, len(self._groups)), dtype=np.bool_)
        pruned = plan is None
        if pruned and "pruner" not in self._manifest.pieces:
            raise no_pruner()
        if plan is not None:
            plans, lowered, legalised = self._settle(plan, written, repair)
        if self._workspace is None or self._workspace.streams != streams:
            self._workspace = None  # give the old memory back first
            self._workspace = Workspace(self._manifest, self._sessions, self._tables, streams)
        work = self._workspace

        start = time.perf_counter()
        try:
            work.start(obs, noise)
            prologue = time.perf_counter()
            if pruned:
                plans, lowered, legalised = self._settle(pruner_plan(work.logits()), written, repair=True)
            pruner = time.perf_counter()
            work.begin()
            sample = decode(work, lowered)
        except BaseException:
            self.reset()  # residuals of this call stand beside those of earlier ones
            raise
        stop = time.perf_counter()
        self._written = written | (plans == Source.COMPUTE)
        wait = milliseconds(prologue, pruner) if pruned else 0.0
        report = CallReport(
            plan=frozen(plans),
            plan_name=plan_name or (PRUNER if pruned else GIVEN),
            computed=computed_cells(plans),
            legalised=legalised,
            flops=tuple(self._manifest.flops.call(one, pruned) for one in plans),
            timings=Timings(
                prologue=milliseconds(start, prologue),
                pruner=wait,
                wait_pruner=wait,
                decode=milliseconds(pruner, stop),
                total=milliseconds(start, stop),
            ),
        )
        return sample, report

    def _settle(
        self, plan: npt.ArrayLike, written: BoolArray, repair: bool
    ) -> tuple[PlanArray, list[Lowered], tuple[int, ...]]:
        """The plan of each stream, its instructions, and how many of its cells were replaced.

        Whether a plan that was lowered before is legal depends on its ROLLOUT reads alone, which is quickly checked.
        """
        streams, steps, blocks = written.shape
        if repair:
            plans, legalised = settle_plan(plan, self._groups, written, repair)
        else:
            plans, legalised = check_plan(plan, steps, blocks, streams), (0,) * streams
        try:
            lowered = [self._lowering.lower(one) for one in plans]
        except IllegalPlanError:
            require_legal(plans, self._groups, written)  # says which stream
            raise
        if any((one.rollout & ~cells).any() for one, cells in zip(lowered, written, strict=True)):
            require_legal(plans, self._groups, written)
        return plans, lowered, legalised


def decode(work: Workspace, lowered: list[Lowered]) -> FloatArray:
    """The denoising loop, from ``work.stream[0]`` to the sample after the last step.

    Args:
        work: observation and noise taken in, residual stream of step 0 made.
        lowered: instructions of each stream.

    Returns:
        The sample, float32 ``[B, T, D]``.
    """
    if all(one is lowered[0] for one in lowered):
        _decode_together(work, lowered[0])
    else:
        _decode_apart(work, lowered)
    return work.sample[len(lowered[0].steps) % 2].copy()


def _decode_together(work: Workspace, lowered: Lowered) -> None:
    """All streams follow one plan: every instruction is one operation on the whole batch."""
    lane = _Lane(lowered, work.residuals, work.table, work.stream)
    blocks = len(work.table)
    advances, residuals = work.advances(), lane.residuals
    bound, add = work.block, np.add
    for k, step in enumerate(lowered.steps):
        stream = lane.stream[k % 2]
        gaps = iter(step.gaps)
        for b in step.blocks:
            gap = next(gaps)
            if gap is not None:
                lane.add(gap, stream)
            bound(k, b).run()
            add(stream, residuals[k * blocks + b], stream)
        gap = next(gaps)
        if gap is not None:
            lane.add(gap, stream)
        advances[k].run()


def _decode_apart(work: Workspace, lowered: list[Lowered]) -> None:
    """Every stream follows its own plan; a block that several compute in a step runs once, on these."""
    lanes = [_Lane.of_stream(work, s, one) for s, one in enumerate(lowered)]
    blocks = len(work.table)
    advances = work.advances()
    for k, rows in enumerate(np.stack([one.computed for one in lowered], axis=1)):
        gaps = [iter(one.steps[k].gaps) for one in lowered]
        for b in np.flatnonzero(rows.any(axis=0)).tolist():
            takers = np.flatnonzero(rows[:, b]).tolist()
            for s in takers:
                lanes[s].add_next(gaps[s], k)
            if len(takers) == work.streams:
                work.block(k, b).run()
            else:
                work.run_some(k, b, takers)
            for s in takers:
                stream = lanes[s].stream[k % 2]
                np.add(stream, lanes[s].residuals[k * blocks + b], stream)
        for lane, rest in zip(lanes, gaps, strict=True):
            lane.add_next(rest, k)
        advances[k].run()


class _Lane:
    """What the instructions of one plan work on: the whole batch, or one stream of it, as views.

    Args:
        lowered: the instructions.
        residuals: ``[K * blocks, ...]``.
        table: ``[blocks, ...]``.
        stream: two arrays ``[...]``.
    """

    def __init__(self, lowered: Lowered, residuals: Array, table: Array, stream: list[Array]) -> None:
        self.residuals, self.stream = _flat(residuals, 1), [_flat(one, 0) for one in stream]
        self._table = _flat(table, 1)
        self._sums = np.empty((lowered.slots, *self._table.shape[1:]), np.float32)
        self._loads = list(zip(lowered.load_blocks.tolist(), lowered.load_cells.tolist(), strict=True))

    @classmethod
    def of_stream(cls, work: Workspace, s: int, lowered: Lowered) -> _Lane:
        """The lane of one stream of the batch."""
        axis = work.axis
        return cls(
            lowered,
            np.moveaxis(work.residuals, axis + 1, 1)[:, s],
            np.moveaxis(work.table, axis + 1, 1)[:, s],
            [np.moveaxis(one, axis, 0)[s] for one in work.stream],
        )

    def add(self, add: Add, stream: Array) -> None:
        """Add a sum to the stream, after making it if it is new."""
        slot, make = add
        total = self._sums[slot]
        if make is not None:
            start, stop, load, load_stop = make
            for b, cell in self._loads[load:load_stop]:  # faster than numpy's indexing by arrays at any length
                self._table[b] = self.residuals[cell]
            np.add.reduce(self._table[start:stop], axis=0, out=total)
        np.add(stream, total, stream)

    def add_next(self, gaps: Iterator[Add | None], k: int) -> None:
        """``add`` the next gap of step k, if any block is reused in it."""
        gap = next(gaps)
        if gap is not None:
            self.add(gap, self.stream[k % 2])


def _flat(array: Array, keep: int) -> Array:
    """The array with all axes after the first ``keep`` made one, where that is a view; else as it is."""
    inner = array[0] if keep else array
    return array.reshape(*array.shape[:keep], -1) if inner.flags.c_contiguous else array
