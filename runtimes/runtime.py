"""What every runtime does alike: settle the plan of a call, know what may be reused, and say what was done.

    caller's thread    start | first_step                                        | other_steps
    helper             ----- | logits, the plan that they make, its instructions  ------------

The helper is one thread that lives as long as the runtime, and only where a pruner makes the plan; it sleeps on a
queue. Everything else runs on the caller's thread. What executes the pieces is a ``Backend``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import wait
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.manifest import DENSE, DISTILLED
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import BoolArray, PlanArray, Source, check_plan, require_legal
from ttscompile.core.spec import FloatArray, Noise
from ttscompile.core.update import bounded
from ttscompile.errors import IllegalPlanError, ObservationError
from ttscompile.ir.pieces import PRUNER

from .arrays import check_noise
from .backend import Backend, Call
from .frames import NO_FRAMES, FramePieces, FrameWork
from .helper import Helper
from .inpainting import known_samples, with_prefix
from .report import GIVEN, CallReport, Timings
from .settle import LoweringCache, pruner_plan, repair_plan

HELPER = "ttscompile-pruner"
"""Name of the helper's thread."""


@dataclass(frozen=True, eq=False)
class _Settled:
    """The plan that a call executes, and what it took to have it."""

    plans: PlanArray  # int8 [B, K, blocks]
    lowered: tuple[Any, ...]  # of each stream, by the backend
    legalised: tuple[int, ...]  # replaced cells of each stream
    pruner: float = 0.0  # ms, from the condition values to the instructions; 0 if the plan was given


class _Opened:
    """A backend for the weights of some plans, and what it made of the plans that it was given."""

    def __init__(self, artifact: Artifact, backend: Backend[Any]) -> None:
        self.backend, self.lowering = backend, LoweringCache(backend.lower)
        self.frames: FramePieces = getattr(backend, "frames", NO_FRAMES)
        for schedule in artifact.schedules.values():
            self.lowering.lower(schedule)


class Runtime:
    """One episode at a time on a fixed number of streams.

    Nothing here locks: a runtime belongs to one process and one thread (``CompiledPolicy`` sees to that).

    Which entries of the rollout cache are kept: of a call with a plan of the artifact, those that the backend says. A
    dense call, and one whose plan is a matrix of the caller's, keeps all that it computes; and from the first such
    matrix on every call does, since another may read any of it.

    A plan with weights of its own (``Artifact.with_weights_of``) has a backend of its own. The one that ``plan`` needs
    is opened at once, another one by the first call that needs it. Between calls with different weights nothing is
    reused.

    Args:
        artifact: loaded and checked.
        open_backend: on an artifact with the weights of some plan.
        plan: name of the plan that most calls will have; None for the artifact's default.
    """

    def __init__(
        self, artifact: Artifact, open_backend: Callable[[Artifact], Backend[Any]], plan: str | None = None
    ) -> None:
        self._artifact, self._open_backend = artifact, open_backend
        self._manifest, self._groups = artifact.manifest, artifact.manifest.groups
        self._opened: dict[bool, _Opened] = {}
        self._used = self._opened_for(self._manifest.default_plan if plan is None else plan)
        pruned = any(plan.pruned for plan in self._manifest.plans.values())
        self._helper = Helper(HELPER) if pruned else None  # its thread is there before the first call
        self._matrices = False  # whether one was ever given
        self._written: BoolArray | None = None
        self._dropped: BoolArray | None = None  # computed in this episode, and not kept

    @property
    def backend(self) -> Backend[Any]:
        """That of the last call."""
        return self._used.backend

    @property
    def streams(self) -> int | None:
        """B of the episode under way; None after ``reset`` and before the first call."""
        return None if self._written is None else len(self._written)

    @property
    def frame_pieces(self) -> int:
        """How many pieces are computed for new frames only; 0 of a backend that computes all frames in every call."""
        return len(self._used.frames)

    @property
    def reuses_tokens(self) -> bool:
        """Whether of new frames only some tokens are computed."""
        return self._used.frames.reuses_tokens

    def reset(self) -> None:
        """Forget the rollout cache and all frames: a new episode, of any number of streams. Its memory is kept."""
        self._end_episode()
        self.forget_frames()

    def forget_frames(self) -> None:
        """Forget all frames, so that the next call computes every one of its own."""
        for one in self._opened.values():
            one.frames.forget()

    def learn(self, obs: Mapping[str, Any], stop: Callable[[], bool]) -> FrameWork:
        """Compute what depends on single frames alone, for calls to come.

        Args:
            obs: as ``predict`` takes it.
            stop: asked before each frame; the rest is left out if it says so.
        """
        return self._used.frames.learn(obs, stop)

    def of_last_steps(self, artifact: Artifact) -> Runtime:
        """The runtime of the last steps of this loop, dense, and with these weights where the backend can share them.

        Args:
            artifact: ``artifact.rest.with_last_steps`` of this one's.
        """
        backend = self._opened_for(DENSE).backend
        return Runtime(artifact, getattr(backend, "of_last_steps", self._open_backend))

    def _end_episode(self) -> None:
        self._written = self._dropped = None

    def require_streams(self, streams: int) -> None:
        """Raise unless a call of so many streams may be the next one.

        Raises:
            ObservationError: the episode under way has another number.
        """
        if self.streams not in (None, streams):
            found = f"the observation holds {streams} streams, and the episode under way {self.streams}"
            raise ObservationError(f"{found}. Call reset() before changing the number of streams.")

    def predict(
        self,
        obs: Mapping[str, FloatArray],
        noise: Noise,
        plan: npt.ArrayLike | None = None,
        *,
        plan_name: str | None = None,
        repair: bool = False,
        correction: Correction | None = None,
        prefix: FloatArray | None = None,
    ) -> tuple[FloatArray, CallReport]:
        """Denoise one chunk. A call that fails after its arguments were checked ends the episode, as ``reset`` does.

        Args:
            obs: normalised observation by key, ``[B, ...]`` each, of the dtype of its specification.
            noise: see ``arrays.check_noise``.
            plan: ``[K, blocks]`` or ``[B, K, blocks]`` of ``Source``; None asks the pruner.
            plan_name: for the report; None for ``pruner`` or ``given``.
            repair: legalise ``plan`` and count it, rather than refuse it when it is illegal.
            correction: of the sampler's steps, which belongs to this plan; None for none.
            prefix: normalised actions that are committed already, ``[B, N, Da]``; see ``inpainting``. None for none.

        Returns:
            The denoised sample, float32 ``[B, T, D]``, and the report.

        Raises:
            IllegalPlanError: ``plan`` has the wrong shape, or is illegal and not to be repaired; or no plan was given
                and the artifact has no pruner.
            ObservationError: the number of streams differs from the episode's, or ``noise`` does not fit.
        """
        spec, streams = self._manifest.spec, len(next(iter(obs.values())))
        self.require_streams(streams)
        noise = check_noise(noise, streams, spec)
        known = None if prefix is None else known_samples(spec, prefix, noise.initial)
        cells = (streams, self._manifest.steps, len(self._groups))
        opened = self._opened_for(plan_name)
        same = opened is self._used  # else what earlier calls kept was computed with other weights
        written = self._written if same and self._written is not None else np.zeros(cells, dtype=np.bool_)
        dropped = self._dropped if same and self._dropped is not None else np.zeros(cells, dtype=np.bool_)
        if plan is None and PRUNER not in self._manifest.pieces:
            remedy = "Give plan='dense', the name of a plan, or a matrix; or calibrate with strategy='tts'."
            raise IllegalPlanError(f"no plan was given and the artifact has no pruner to make one. {remedy}")
        settled = None if plan is None else self._settle(opened.lowering, plan, written, dropped, repair)
        if plan_name not in (DENSE, *self._manifest.plans):
            self._matrices = True
        self._used, backend = opened, opened.backend
        keep = np.ones_like(backend.keeps) if self._matrices or plan_name == DENSE else backend.keeps
        self._end_episode()  # a call that fails ends the episode: its residuals stand beside those of earlier ones
        backend.prepare(streams, None if settled is None else settled.lowered)

        start = time.perf_counter()
        backend.start(Call(obs, noise, correction, known, keep, written))
        prologue = time.perf_counter()
        waited = 0.0
        if settled is None:
            settled, waited = self._prune_beside_first_step(written)
        else:
            backend.first_step()
        sample = backend.other_steps(settled.lowered)
        if correction is not None:
            sample = with_prefix(bounded(spec.sampler, sample), known)
        stop = time.perf_counter()
        computed = settled.plans == Source.COMPUTE.value
        self._written, self._dropped = np.where(computed, keep, written), np.where(computed, ~keep, dropped)
        executed = settled.plans.copy()  # the caller's plan is the caller's
        executed.flags.writeable = False
        report = CallReport(
            plan=executed,
            plan_name=plan_name or (PRUNER if plan is None else GIVEN),
            computed=tuple(int(n) for n in np.count_nonzero(computed, axis=(1, 2))),
            legalised=settled.legalised,
            flops=tuple(self._manifest.flops.call(one, plan is None, correction) for one in settled.plans),
            frames=self._used.frames.work,
            timings=Timings(
                prologue=_milliseconds(start, prologue),
                pruner=settled.pruner,
                wait_pruner=waited,
                decode=_milliseconds(prologue, stop) - waited,
                total=_milliseconds(start, stop),
                frames=self._used.frames.work.waited,
            ),
        )
        return sample, report

    def _opened_for(self, plan: str | None) -> _Opened:
        """What computes the plan of this name, with its weights."""
        own = plan == DISTILLED and self._manifest.distilled is not None
        if own not in self._opened:
            artifact = self._artifact.with_weights_of(plan)
            self._opened[own] = _Opened(artifact, self._open_backend(artifact))
        return self._opened[own]

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

    def _settle(
        self,
        lowering: LoweringCache[Any],
        plan: npt.ArrayLike,
        written: BoolArray,
        dropped: BoolArray,
        repair: bool,
    ) -> _Settled:
        """The plan of a caller.

        Whether a plan that was lowered before is legal depends on its ROLLOUT reads alone, which is quickly checked.
        """
        streams, steps, blocks = written.shape
        if repair:
            plans, legalised = repair_plan(plan, written)
        else:
            plans, legalised = check_plan(plan, steps, blocks, streams), (0,) * streams
        rollout = plans == Source.ROLLOUT.value
        if (rollout & dropped).any():
            _, k, b = np.argwhere(rollout & dropped)[0].tolist()
            raise IllegalPlanError(
                f"the plan reads the ROLLOUT residual of step {k}, block {b}, which an earlier call of this episode"
                " computed with a plan of the artifact, and did not keep. Begin the episode with a matrix (one of zeros"
                " computes all, as plan='dense' does): from a first matrix on every call keeps what it computes."
            )
        check = partial(require_legal, plans, self._groups, written)
        if (rollout & ~written).any():
            check()
        return _Settled(plans, tuple(lowering.lower(one, check) for one in plans), legalised)


def _prune(backend: Backend[Any], lowering: LoweringCache[Any], written: BoolArray) -> _Settled:
    """The pruner's plan and its instructions. Not a method: the helper must not keep the runtime alive."""
    start = time.perf_counter()
    plans, legalised = repair_plan(pruner_plan(backend.logits()), written)
    lowered = tuple(lowering.lower(one) for one in plans)
    return _Settled(plans, lowered, legalised, _milliseconds(start, time.perf_counter()))


def _milliseconds(start: float, stop: float) -> float:
    """Milliseconds between two readings of ``time.perf_counter``."""
    return 1000.0 * (stop - start)
