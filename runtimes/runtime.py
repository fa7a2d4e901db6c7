"""What every runtime does alike: settle the plan of a call, know what may be reused, and say what was done.

    caller's thread    start | first_step                                        | other_steps
    helper             ----- | logits, the plan that they make, its instructions  ------------

The helper is one thread that lives as long as the runtime, and only where a pruner makes the plan; it sleeps on a
queue. Everything else runs on the caller's thread. What executes the pieces is a ``Backend``.
"""

import time
from collections.abc import Callable, Mapping
from concurrent.futures import wait
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ttscompile.artifact.corrections import require_fit
from ttscompile.artifact.load import Artifact
from ttscompile.artifact.view import View, view_of
from ttscompile.core.envelope import FAR, plain_cells
from ttscompile.core.lattice import BoolArray, PlanArray, Source, check_plan, require_legal, without_illegal_reads
from ttscompile.core.plan import DENSE, Plan, Variant
from ttscompile.core.spec import FloatArray, Noise, PolicySpec
from ttscompile.core.update import bounded
from ttscompile.errors import IllegalPlanError, ObservationError
from ttscompile.ir.pieces import PRUNER

from .arrays import check_noise
from .backend import Backend, Call
from .frames import NO_FRAMES, FramePieces, FrameWork
from .helper import Helper
from .inpainting import known_samples, with_prefix
from .plans import LoweringCache, pruner_plan, repair_plan
from .report import GIVEN, CallReport, Timings

HELPER = "ttscompile-pruner"
"""Name of the helper's thread."""


@dataclass(frozen=True, eq=False)
class _Entries:
    """Entries of the rollout cache in the episode under way, bool ``[B, K, blocks]`` each."""

    written: BoolArray  # kept, so that a plan may read them
    dropped: BoolArray  # computed, and not kept

    @classmethod
    def none(cls, streams: int, steps: int, blocks: int) -> "_Entries":
        return cls(*np.zeros((2, streams, steps, blocks), np.bool_))

    def after(self, computed: BoolArray, keep: BoolArray) -> "_Entries":
        return _Entries(np.where(computed, keep, self.written), np.where(computed, ~keep, self.dropped))


@dataclass(frozen=True, eq=False)
class _Settled:
    """The plan that a call executes, and what it took to have it."""

    plans: PlanArray  # int8 [B, K, blocks]
    lowered: tuple[Any, ...]  # of each stream, by the backend
    legalised: tuple[int, ...]  # replaced cells of each stream
    pruner: float = 0.0  # ms, from the condition values to the instructions; 0 if the plan was given

    def but(self, some: BoolArray, other: "_Settled") -> "_Settled":
        """The same with the plans of another where ``some [B]`` is True."""
        plans = np.where(some[:, None, None], other.plans, self.plans)
        return replace(self, plans=plans, legalised=tuple(np.where(some, other.legalised, self.legalised).tolist()))


@dataclass(frozen=True, eq=False)
class _Made:
    """What a call came to."""

    sample: FloatArray
    settled: _Settled
    outside: FloatArray  # ``CallReport.outside``
    timings: Timings
    frames: FrameWork
    mixed: bool  # whether some streams were far outside, and others not: then no residual can be reused


class _Opened:
    """A backend for the plans of one variant, and what it made of the plans that it was given."""

    def __init__(self, view: View, backend: Backend[Any]) -> None:
        self.view, self.backend, self.lowering = view, backend, LoweringCache(backend.lower)
        self.frames: FramePieces = getattr(backend, "frames", NO_FRAMES)
        for schedule in view.schedules.values():
            self.lowering.lower(schedule)


class Runtime:
    """One episode at a time on a fixed number of streams.

    Nothing here locks: a runtime belongs to one process and one thread (``CompiledPolicy`` sees to that).

    Which entries of the rollout cache are kept: of a call with a plan of the artifact, those that the backend says. A
    dense call, and one whose plan is the caller's, keeps all that it computes; and from the first such plan on every
    call does, since another may read any of it.

    Each variant of a plan (its loop, weights, precision and tokens) has a backend of its own, which shares with the
    others what they have in common. The one that ``plan`` needs is opened at once, another one by the first call that
    needs it. Between calls of different variants no residual is reused.

    A plan whose loop begins with the chunk of the call before has that of the last call of the episode, moved by what
    is executed of it. Where there is none, its ``otherwise`` is executed.

    Attributes:
        streams: B of the episode under way; None after ``reset`` and before the first call.
    """

    def __init__(
        self, artifact: Artifact, open_backend: Callable[[View], Backend[Any]], plan: Plan | None = None
    ) -> None:
        self._artifact, self._open_backend = artifact, open_backend
        self._views: dict[Variant, View] = {}
        self._opened: dict[Variant, _Opened] = {}
        plan = artifact.default if plan is None else plan
        if plan.otherwise is not None:
            self._opened_for(plan.otherwise)
        self._used = self._opened_for(plan)
        plans = artifact.plans.values()
        self._reading = any(one.cells is None or Source.ROLLOUT in one.cells for one in plans)  # of earlier calls
        self._helper = Helper(HELPER) if any(one.pruned for one in plans) else None  # there before the first call
        self._given = False  # whether a plan that is not the artifact's ever was
        self._entries: _Entries | None = None  # None before the first call of an episode
        self.streams: int | None = None
        self._chunk: FloatArray | None = None  # denoised sample of the last call of the episode
        self._reference: FloatArray | None = None  # what its actions are relative to
        self._executed: int | None = None  # steps of it; None for all of ``action``

    def view(self, plan: Plan) -> View:
        """The artifact as a plan sees it; nothing is opened. Raises IllegalPlanError: it names what there is not."""
        if plan.variant not in self._views:
            self._views[plan.variant] = view_of(self._artifact, plan)
        view = self._views[plan.variant]
        record, other = self._artifact.manifest.starts.get(plan.loop), plan.otherwise
        if (None if other is None else other.loop) != (None if record is None else record.loop):
            expected = "the plan of a call that has no chunk to begin with" if record else "none"
            loop = f", which is in loop {record.loop!r}" if record else ""
            raise IllegalPlanError(f"a plan of loop {plan.loop!r}: expected {expected} as otherwise{loop}.")
        return view

    @property
    def backend(self) -> Backend[Any]:
        """That of the last call."""
        return self._used.backend

    @property
    def frames(self) -> FramePieces:
        """What is computed for new frames only; nothing of a backend that computes all frames in every call."""
        return self._used.frames

    def reset(self) -> None:
        """Forget the rollout cache and all frames: a new episode, of any number of streams. Its memory is kept."""
        self._end_episode()
        self.forget_frames()

    def forget_frames(self) -> None:
        """Forget all frames, so that the next call computes every one of its own."""
        for one in self._opened.values():
            one.frames.forget()

    def follow(self, executed: int) -> None:
        """Say how many steps of the last chunk are executed before the next call, where it is not all of ``action``.

        A plan that begins with the chunk of the call before moves it by as many. Where more were due than ``action``
        has, the call is late, and begins with noise: its plan's ``otherwise`` takes its place.
        """
        self._executed = executed
        if not 0 <= executed <= self._artifact.manifest.spec.chunk.executes:
            self._chunk = None

    def _end_episode(self) -> None:
        self._entries = self._chunk = self.streams = self._executed = None

    def require_streams(self, streams: int) -> None:
        """Raise ObservationError if the episode under way has another number of streams."""
        if self.streams not in (None, streams):
            found = f"the observation holds {streams} streams, and the episode under way {self.streams}"
            raise ObservationError(f"{found}. Call reset() before changing the number of streams.")

    def predict(
        self, obs: Mapping[str, FloatArray], noise: Noise, plan: Plan, prefix: FloatArray | None = None
    ) -> tuple[FloatArray, CallReport]:
        """Denoise one chunk. A call that fails after its arguments were checked ends the episode, as ``reset`` does.

        Args:
            obs: normalised observation by key, ``[B, ...]`` each, of the dtype of its specification.
            noise: see ``arrays.check_noise``; of the whole loop, also where the call begins with the chunk before.
            prefix: normalised actions that are committed already, ``[B, N, Da]``; see ``inpainting``. None for none.

        Returns:
            The denoised sample, float32 ``[B, T, D]``, and the report.

        Raises:
            IllegalPlanError: the plan names what the artifact lacks, its cells have the wrong shape, or are illegal and
                not to be repaired.
            ObservationError: the number of streams differs from the episode's, or ``noise`` does not fit.
            RuntimeUnavailableError: this runtime cannot do what the plan asks for.
        """
        streams = len(next(iter(obs.values())))
        self.require_streams(streams)
        if plan.otherwise is not None and self._chunk is None:
            plan = plan.otherwise
        opened = self._opened_for(plan)
        name, told = self._artifact.name_of(plan), self._artifact.told(plan)
        if name is None:
            self._require_executable(plan, opened.view)
        given = self._given or (name is None and (told is None or self._reading))
        keep = np.ones_like(opened.backend.keeps) if given or name == DENSE else opened.backend.keeps
        entries = self._entries if opened is self._used else None  # else what earlier calls kept is of another variant
        entries = entries or _Entries.none(streams, *keep.shape)
        spec = opened.view.manifest.spec
        reference = spec.reference(obs)
        noise = self._noise(plan, opened.view, noise, streams, reference)
        known = None if prefix is None else known_samples(spec, prefix, noise.initial)
        committed = 0 if known is None else known.values.shape[2]
        correction = plan.correction and plan.correction.of(committed)
        obs = {**obs, **spec.committed(streams, committed)}
        call = Call(obs, noise, correction, known, keep, entries.written)
        settled = None if plan.cells is None else self._settle(opened, plan.cells, entries, plan.repair)
        self._given, self._used = given, opened
        self._end_episode()  # a call that fails ends the episode: its residuals stand beside those of earlier ones
        opened.backend.prepare(streams, None if settled is None else settled.lowered)
        made = self._denoised(opened, plan, call, settled)
        computed = made.settled.plans == Source.COMPUTE.value
        # Of streams with different plans no cell has residuals of all: as if none had been computed.
        self._entries = _Entries.none(*computed.shape) if made.mixed else entries.after(computed, keep)
        self.streams, self._chunk, self._reference = streams, made.sample, reference
        executed = made.settled.plans.copy()  # the caller's plan is the caller's
        executed.flags.writeable = False
        flops = opened.view.manifest.flops
        report = CallReport(
            plan=executed,
            plan_name=told or GIVEN,
            loop=plan.loop,
            computed=tuple(int(n) for n in np.count_nonzero(computed, axis=(1, 2))),
            legalised=made.settled.legalised,
            flops=tuple(flops.call(one, plan.pruned, correction) for one in executed),
            frames=made.frames,
            outside=tuple(made.outside.tolist()),
            unfitted=correction is not None and committed > correction.prefixes,
            timings=made.timings,
        )
        return made.sample, report

    def _require_executable(self, plan: Plan, view: View) -> None:
        """Raise IllegalPlanError if a plan that somebody made has a correction that does not fit, or lacks a pruner."""
        if plan.correction is not None:
            require_fit(plan.correction, self._artifact.manifest, plan.loop)
        if plan.cells is None and PRUNER not in view.manifest.pieces:
            remedy = "Give a plan with cells: plan='dense', or the name of another one"
            raise IllegalPlanError(f"a plan without cells needs a pruner, and loop {plan.loop!r} has none. {remedy}.")

    def _noise(self, plan: Plan, view: View, noise: Noise, streams: int, reference: FloatArray | None) -> Noise:
        """That of a call, checked; made of the chunk of the call before where the plan begins with it."""
        noise = check_noise(noise, streams, self.noise_spec(plan))
        if view.start is None or self._chunk is None:
            return noise
        change = None if reference is None or self._reference is None else (self._reference, reference)
        return view.start.noise_from(self._chunk, view.manifest.spec.chunk, noise, self._executed, change)

    def _denoised(self, opened: _Opened, plan: Plan, call: Call, settled: _Settled | None) -> _Made:
        """The sample of a call. Streams that are far outside of what was recorded have ``plain_cells``, uncorrected."""
        backend, envelope, waited = opened.backend, self._artifact.envelope, 0.0
        outside, far = np.zeros(0, np.float32), np.zeros(len(call.noise.initial), np.bool_)
        start = time.perf_counter()
        backend.start(call)
        prologue, frames = time.perf_counter(), opened.frames.work
        if plan.correction is not None and envelope is not None:
            outside = envelope.distance(backend.condition())
            far = outside > FAR
        if far.all():
            settled, sample = self._plain(opened, plan, call)
        else:
            if settled is None:
                settled, waited = self._prune_beside_first_step(call.written)
            else:
                backend.first_step()
            sample = backend.other_steps(settled.lowered)
            if plan.correction is not None:
                sample = with_prefix(bounded(opened.view.manifest.spec.sampler, sample), call.known)
            if far.any():
                plain, own = self._plain(opened, plan, call)
                settled, sample = settled.but(far, plain), np.where(far[:, None, None], own, sample)
        stop = time.perf_counter()
        timings = Timings(
            prologue=_milliseconds(start, prologue),
            pruner=settled.pruner,
            wait_pruner=waited,
            decode=_milliseconds(prologue, stop) - waited,
            total=_milliseconds(start, stop),
            frames=frames.waited,
        )
        return _Made(sample, settled, outside, timings, frames, mixed=bool(far.any() and not far.all()))

    def _plain(self, opened: _Opened, plan: Plan, call: Call) -> tuple[_Settled, FloatArray]:
        """``plain_cells`` in the place of a plan, and the sample of a call with these. The call's prologue stands."""
        assert plan.correction is not None  # else no stream is far outside
        cells = plain_cells(plan.correction, call.written.shape[2])
        settled = self._settle(opened, cells, _Entries(call.written, np.zeros_like(call.written)), True)
        opened.backend.start(replace(call, obs={}, correction=None))
        opened.backend.first_step()
        return settled, opened.backend.other_steps(settled.lowered)

    def noise_spec(self, plan: Plan) -> PolicySpec:
        """What noise has to fit: of the loop whose last steps these are, where the plan begins with a chunk."""
        return self.view(plan if plan.otherwise is None else plan.otherwise).manifest.spec

    def _opened_for(self, plan: Plan) -> _Opened:
        if plan.variant not in self._opened:
            view = self.view(plan)
            self._opened[plan.variant] = _Opened(view, self._open_backend(view))
        return self._opened[plan.variant]

    def _prune_beside_first_step(self, written: BoolArray) -> tuple[_Settled, float]:
        """Step 0, and meanwhile the plan of the steps after it; ms that the loop stood still for it."""
        self._helper = self._helper or Helper(HELPER)
        pruning = self._helper.submit(partial(_prune, self.backend, self._used.lowering, written))
        try:
            self.backend.first_step()
            ready = time.perf_counter()
            return pruning.result(), _milliseconds(ready, time.perf_counter())
        finally:
            wait([pruning])  # it reads the backend's memory: nobody may go on before it is done, not even with an error

    def _settle(self, opened: _Opened, cells: PlanArray, entries: _Entries, repair: bool) -> _Settled:
        """The plans of cells that were given, repaired if they may be; illegal ones are refused.

        Whether a plan that was lowered before is legal depends on its ROLLOUT reads alone, which is quickly checked.
        """
        streams, steps, blocks = entries.written.shape
        wanted = check_plan(cells, steps, blocks, streams)
        plans = without_illegal_reads(wanted, entries.written) if repair else wanted
        rollout = wanted == Source.ROLLOUT.value
        if (rollout & entries.dropped).any():
            _, k, b = np.argwhere(rollout & entries.dropped)[0].tolist()
            raise IllegalPlanError(
                f"the plan reads the ROLLOUT residual of step {k}, block {b}, which an earlier call of this episode"
                " computed with a plan of the artifact, and did not keep. Begin the episode with a matrix (one of zeros"
                " computes all, as plan='dense' does): from a first matrix on every call keeps what it computes."
            )
        check = partial(require_legal, plans, opened.view.manifest.groups, entries.written)
        if not repair and (rollout & ~entries.written).any():
            check()
        legalised = tuple(np.count_nonzero(plans != wanted, axis=(1, 2)).tolist())
        return _Settled(plans, tuple(opened.lowering.lower(one, check) for one in plans), legalised)


def _prune(backend: Backend[Any], lowering: LoweringCache[Any], written: BoolArray) -> _Settled:
    """The pruner's plan and its instructions. Not a method: the helper must not keep the runtime alive."""
    start = time.perf_counter()
    plans, legalised = repair_plan(pruner_plan(backend.logits()), written)
    lowered = tuple(lowering.lower(one) for one in plans)
    return _Settled(plans, lowered, legalised, _milliseconds(start, time.perf_counter()))


def _milliseconds(start: float, stop: float) -> float:
    return 1000.0 * (stop - start)
