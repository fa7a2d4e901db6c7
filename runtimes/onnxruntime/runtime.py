"""The product on the CPU: numpy and onnxruntime, a session a piece, plans lowered to short lists of instructions.

    caller's thread    prologue | stem, dense step 0            | steps 1..K-1
    helper             --------   pruner, its plan, lowering     --------------

The helper is one thread that lives as long as the runtime, and only where a pruner makes the plan; it sleeps on a
queue. Everything else runs on the caller's thread, beside what onnxruntime does with the threads it was given.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ttscompile.artifact.manifest import DENSE
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import BoolArray, PlanArray, Source, check_plan, require_legal
from ttscompile.core.spec import FloatArray, Noise
from ttscompile.errors import IllegalPlanError
from ttscompile.ir.pieces import PRUNER
from ttscompile.runtimes.base import (
    GIVEN,
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
from ttscompile.runtimes.inpainting import Known

from .decode import decode_first, decode_rest
from .instructions import Lowered, LoweringCache
from .liveness import readable_rollout
from .sessions import open_blocks, open_sessions
from .workspace import Workspace

if TYPE_CHECKING:
    from ttscompile.artifact.load import Artifact


@dataclass(frozen=True, eq=False)
class _Settled:
    """The plan that a call executes: of each stream, its instructions, and what it took to have them.

    Attributes:
        plans: int8 ``[B, K, blocks]``.
        lowered: of each stream.
        legalised: replaced cells of each stream.
        pruner: ms that the pruner took, from the condition values to the instructions; 0 if the plan was given.
    """

    plans: PlanArray
    lowered: tuple[Lowered, ...]
    legalised: tuple[int, ...]
    pruner: float = 0.0


class OnnxRuntime:
    """A ``Runtime`` on onnxruntime; see ``base.Runtime``.

    Which entries of the rollout cache are kept: of a call with a plan of the artifact, those that some plan of the
    artifact can read. A dense call, and one whose plan is a matrix of the caller's, keeps all that it computes; and
    from the first such matrix on every call does, since another may read any of it.

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
        self._artifact, self._threads = artifact, threads
        self._groups = self._manifest.groups
        self._lowering = LoweringCache(self._groups)
        self._schedules = tuple(self._lowering.lower(plan) for plan in artifact.schedules.values())
        pruned = any(plan.pruned for plan in self._manifest.plans.values())
        self._blocks = pruned or any(one.partial for one in self._schedules)  # whether single blocks have sessions
        self._sessions = open_sessions(artifact, threads, self._blocks)
        self._readable = readable_rollout(artifact)
        self._corrections = tuple(artifact.corrections.values())
        self._matrices = False  # whether one was ever given
        self._written: BoolArray | None = None
        self._dropped: BoolArray | None = None  # computed in this episode, and not kept
        self._helper = ThreadPoolExecutor(1, "ttscompile-pruner") if PRUNER in self._manifest.pieces else None
        self._slots = max((one.slots for one in self._schedules), default=0)
        self._workspace: Workspace | None = self._open_workspace(1)

    @property
    def streams(self) -> int | None:
        """B of the episode under way."""
        return None if self._written is None else len(self._written)

    @property
    def nbytes(self) -> int:
        """Memory of the buffers of the batch size under way, the rollout cache included; weights are onnxruntime's."""
        return 0 if self._workspace is None else self._workspace.nbytes

    @property
    def rollout_nbytes(self) -> int:
        """Memory of the rollout cache."""
        return 0 if self._workspace is None else self._workspace.rollout.nbytes

    def reset(self) -> None:
        """Forget the rollout cache; its memory is kept for the next episode."""
        self._written = self._dropped = None

    def predict(
        self,
        obs: Mapping[str, FloatArray],
        noise: Noise,
        plan: npt.ArrayLike | None = None,
        *,
        plan_name: str | None = None,
        repair: bool = False,
        correction: Correction | None = None,
        known: Known | None = None,
    ) -> tuple[FloatArray, CallReport]:
        """Denoise one chunk; see ``base.Runtime.predict``."""
        spec = self._manifest.spec
        streams = check_call(self.streams, noise, spec.sample, spec.sampler)
        cells = (streams, spec.sampler.steps, len(self._groups))
        written = np.zeros(cells, dtype=np.bool_) if self._written is None else self._written
        dropped = np.zeros(cells, dtype=np.bool_) if self._dropped is None else self._dropped
        if plan is None and self._helper is None:
            raise no_pruner()
        settled = None if plan is None else self._settle(plan, written, dropped, repair)
        if plan_name not in (DENSE, *self._manifest.plans):
            self._matrices = True
        if self._workspace is None or self._workspace.streams != streams:
            self._workspace = None  # give the old memory back first; there may be too little for the new
            self._workspace = self._open_workspace(streams)
        work = self._workspace
        if settled is not None:
            self._require_blocks(work, settled.lowered)
        keep_all = self._matrices or plan_name == DENSE
        keep = np.ones_like(self._readable) if keep_all else self._readable

        start = time.perf_counter()
        self.reset()  # a call that fails ends the episode: its residuals stand beside those of earlier ones
        work.start(obs, noise, correction, known)
        prologue = time.perf_counter()
        waited = 0.0
        if settled is None:
            settled, waited = self._prune_beside_first_step(work, written, keep)
            self._require_blocks(work, settled.lowered)
        else:
            decode_first(work, keep)
        decode_rest(work, settled.lowered, keep)
        sample = work.result()
        stop = time.perf_counter()
        computed = settled.plans == Source.COMPUTE
        self._written, self._dropped = np.where(computed, keep, written), np.where(computed, ~keep, dropped)
        report = CallReport(
            plan=frozen(settled.plans),
            plan_name=plan_name or (PRUNER if plan is None else GIVEN),
            computed=computed_cells(settled.plans),
            legalised=settled.legalised,
            flops=tuple(self._manifest.flops.call(one, plan is None) for one in settled.plans),
            timings=Timings(
                prologue=milliseconds(start, prologue),
                pruner=settled.pruner,
                wait_pruner=waited,
                decode=milliseconds(prologue, stop) - waited,
                total=milliseconds(start, stop),
            ),
        )
        return sample, report

    def _prune_beside_first_step(self, work: Workspace, written: BoolArray, keep: BoolArray) -> tuple[_Settled, float]:
        """Step 0, and meanwhile the plan of the steps after it; ms that the loop stood still for it."""
        assert self._helper is not None
        pruning: Future[_Settled] = self._helper.submit(_prune, work, written, self._groups, self._lowering)
        try:
            decode_first(work, keep)
            ready = time.perf_counter()
            return pruning.result(), milliseconds(ready)
        finally:
            wait([pruning])  # it reads the workspace: nobody may go on before it is done, not even with an error

    def _settle(self, plan: npt.ArrayLike, written: BoolArray, dropped: BoolArray, repair: bool) -> _Settled:
        """The plan of a caller.

        Whether a plan that was lowered before is legal depends on its ROLLOUT reads alone, which is quickly checked.
        """
        streams, steps, blocks = written.shape
        if repair:
            plans, legalised = settle_plan(plan, self._groups, written, repair)
        else:
            plans, legalised = check_plan(plan, steps, blocks, streams), (0,) * streams
        try:
            lowered = tuple(self._lowering.lower(one) for one in plans)
        except IllegalPlanError:
            require_legal(plans, self._groups, written)  # says which stream
            raise
        for one, cells, gone in zip(lowered, written, dropped, strict=True):
            if (one.rollout & gone).any():
                k, b = np.argwhere(one.rollout & gone)[0].tolist()
                raise IllegalPlanError(
                    f"the plan reads the ROLLOUT residual of step {k}, block {b}, which an earlier call of this episode"
                    " computed with a plan of the artifact, and did not keep: no plan of the artifact reads it."
                    " Begin the episode with a matrix (one of zeros computes all, as plan='dense' does): from a first"
                    " matrix on every call keeps what it computes."
                )
            if (one.rollout & ~cells).any():
                require_legal(plans, self._groups, written)
        return _Settled(plans, lowered, legalised)

    def _require_blocks(self, work: Workspace, lowered: tuple[Lowered, ...]) -> None:
        """Open the sessions of single blocks, if these plans are the first to need them."""
        if not self._blocks and any(one.partial for one in lowered):
            self._sessions |= open_blocks(self._artifact, self._threads)
            work.bind_blocks()
            self._blocks = True

    def _open_workspace(self, streams: int) -> Workspace:
        """The workspace of a batch size, after a step on zeros.

        So the first call costs what the others do: sessions have their memory, pages are committed, and the helper's
        thread is there.
        """
        work = Workspace(self._manifest, self._sessions, self._tables, streams)
        work.sums(self._slots)
        for correction in self._corrections:
            work.prepare(correction)
        for lowered in self._schedules:
            for k in np.flatnonzero(lowered.computed.all(axis=1)).tolist():
                work.bind_dense(k)
        for cell in np.flatnonzero(self._readable).tolist():
            work.rollout.entry(cell)
        spec = self._manifest.spec
        obs = {key: np.zeros((streams, *one.shape), one.dtype) for key, one in spec.observations.items()}
        with np.errstate(all="ignore"):  # zeros need not be in the range of the policy
            work.start(obs, Noise(np.zeros((streams, *spec.sample), np.float32)), None)
            decode_first(work, np.zeros_like(self._readable))
            for k in range(spec.sampler.steps):
                work.advance(k)
        if self._helper is not None and any(plan.pruned for plan in self._manifest.plans.values()):
            self._helper.submit(work.logits).result()
        return work


def _prune(work: Workspace, written: BoolArray, groups: tuple[int, ...], lowering: LoweringCache) -> _Settled:
    """The pruner's plan and its instructions. Not a method: the helper must not keep the runtime alive."""
    start = time.perf_counter()
    plans, legalised = settle_plan(pruner_plan(work.logits()), groups, written, repair=True)
    lowered = tuple(lowering.lower(one) for one in plans)
    return _Settled(plans, lowered, legalised, milliseconds(start))
