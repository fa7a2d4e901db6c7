"""The product on the CPU: numpy and onnxruntime, a session a piece, plans lowered to short lists of instructions.

Its loop (``decode``, ``workspace``) shares nothing with the reference's on purpose: each is the other's test.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from ttscompile.artifact.view import View
from ttscompile.core.lattice import PlanArray
from ttscompile.core.spec import FloatArray, Noise
from ttscompile.runtimes.backend import Call
from ttscompile.runtimes.frames import FramePieces
from ttscompile.runtimes.instructions import Instructions, by_plan, instructions_of
from ttscompile.runtimes.liveness import readable_rollout
from ttscompile.runtimes.tokens import token_towers

from .decode import decode_first, decode_rest
from .sessions import Sessions, renew_piece, run_piece
from .workspace import Workspace


class OnnxBackend:
    """A ``Backend`` on onnxruntime.

    Args:
        view: of an artifact.
        sessions: of the artifact's models; those of other views are shared.
        known: what backends of other views remember of frames, by ``View.frames_key``, to share it.

    Attributes:
        keeps: entries of the rollout cache that some plan of the view can read.
        frames: what depends on one frame alone.
        sessions: by piece; those of single blocks only once a plan needs them.
        workspace: of the batch size under way; None after one that found no memory.

    Raises:
        RuntimeUnavailableError: onnxruntime is missing, or other code has made its global thread pool.
        ArtifactError: onnxruntime refuses a graph.
    """

    def __init__(self, view: View, sessions: Sessions, known: dict[object, FramePieces]) -> None:
        self._manifest, self._view, self._pool = view.manifest, view, sessions
        groups, plans = self._manifest.groups, view.schedules.values()
        self._lowered = {plan.tobytes(): instructions_of(plan, groups) for plan in plans}
        self._schedules = tuple(self._lowered.values())
        self._blocks = view.pruned or any(one.partial for one in self._schedules)  # whether these have sessions
        self.sessions = sessions.of(view, self._blocks)
        self._run = partial(run_piece, self.sessions, self._manifest.pieces)  # which does not keep the backend alive
        self._renew = partial(renew_piece, self.sessions)
        self.frames = known.setdefault(view.frames_key, self._open_frames())
        self.keeps = readable_rollout(view)
        self.workspace: Workspace | None = self._open_workspace(1)
        self._some: dict[int, Workspace] = {}  # for streams of a batch that follow a plan of their own

    def lower(self, plan: PlanArray) -> Instructions:
        return self._lowered.get(plan.tobytes()) or instructions_of(plan, self._manifest.groups)

    def prepare(self, streams: int, plans: Sequence[Instructions] | None) -> None:
        """Make the workspace of a batch size, and the sessions of single blocks for the first plans that need them."""
        if self.workspace is None or self.workspace.streams != streams:
            self.workspace = None  # give the old memory back first; there may be too little for the new
            self._some.clear()
            self.workspace = self._open_workspace(streams)
        if not self._blocks and (plans is None or any(one.partial for one in plans)):
            self.sessions |= self._pool.of_blocks(self._view)
            for work in (self.workspace, *self._some.values()):
                work.bind_blocks()
            self._blocks = True

    def start(self, call: Call) -> None:
        self._keep = call.keep
        obs = {**call.obs, **self.frames.values(call.obs)} if call.obs else {}
        self._work.start(obs, call.noise, call.correction, call.known)

    def condition(self) -> FloatArray:
        return self._work.condition()

    def logits(self) -> FloatArray:
        return self._work.logits()

    def first_step(self) -> None:
        decode_first(self._work, self._keep)

    def other_steps(self, plans: Sequence[Instructions]) -> FloatArray:
        streams = by_plan(plans)
        if len(streams) == 1:
            decode_rest(self._work, plans[0], self._keep)
        else:
            for plan, some in streams.items():
                self._decode_some(plan, some)
        return self._work.result()

    def _decode_some(self, plan: Instructions, streams: Sequence[int]) -> None:
        """The steps after step 0 for the streams of a batch that follow this plan."""
        if len(streams) not in self._some:
            self._some[len(streams)] = Workspace(self._view, self.sessions, len(streams))
        work, kept = self._some[len(streams)], plan.computed & self._keep
        kept[0] = False  # step 0 was all streams'
        work.take(self._work, streams, np.flatnonzero(plan.rollout).tolist())
        decode_rest(work, plan, self._keep)
        work.give(self._work, streams, np.flatnonzero(kept).tolist())

    def _open_frames(self) -> FramePieces:
        towers = token_towers(self._manifest, self._view.variant.tokens, self._run, self._renew)
        return FramePieces(self._manifest.pieces, self._run, towers)

    @property
    def _work(self) -> Workspace:
        assert self.workspace is not None  # ``prepare``
        return self.workspace

    def _open_workspace(self, streams: int) -> Workspace:
        """The workspace of a batch size, after a step on zeros.

        So the first call costs what the others do: sessions have their memory, and pages are committed.
        """
        work = Workspace(self._view, self.sessions, streams)
        work.sums(max((one.slots for one in self._schedules), default=0))
        for plan in self._view.plans.values():
            if plan.correction is not None:
                work.advances_with(plan.correction)
        for lowered in self._schedules:
            for k in np.flatnonzero(lowered.computed.all(axis=1)).tolist():
                work.bind_dense(k)
        for cell in np.flatnonzero(self.keeps).tolist():
            work.entry(cell)
        spec = self._manifest.spec
        obs = {key: one.normalized(np.zeros((streams, *one.shape), one.dtype)) for key, one in spec.inputs.items()}
        with np.errstate(all="ignore"):  # zeros need not be in the range of the policy
            seen = self._open_frames().values(obs)  # none of these is to be remembered
            work.start({**obs, **seen}, Noise(np.zeros((streams, *spec.sample), np.float32)), None)
            decode_first(work, np.zeros_like(self.keeps))
            for k in range(spec.sampler.steps):
                work.advance(k)
            if self._view.pruned:
                work.logits()
        return work
