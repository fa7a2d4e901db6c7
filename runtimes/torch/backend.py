"""A call as one straight line of torch: any device, CUDA graphs where there is one.

What the line computes is in ``loop``; between which tensors, in ``workspace``. A *line* is a call, or a part of one,
between tensors that stay where they are: a function of no arguments that reads some of them and writes others, never
looks at their values, and does the same operations every time. On CUDA that is what a graph can be captured of.
Everywhere else it simply runs; ``Lines`` is the one place where it matters.
It shares no loop with the reference, which stays slow and literal: each is the other's test.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any
from weakref import WeakSet

import numpy as np
import torch

from ttscompile.artifact.view import View
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import BoolArray, PlanArray, dense_plan, without_illegal_reads
from ttscompile.core.spec import FloatArray
from ttscompile.runtimes.backend import Call, fitting
from ttscompile.runtimes.inpainting import MaskedUpdates
from ttscompile.runtimes.instructions import Instructions, by_plan, instructions_of
from ttscompile.runtimes.liveness import readable_rollout

from .devices import exact_arithmetic
from .network import Parts, Placed
from .sampler import Advance
from .workspace import Workspace


class TorchBackend:
    """A ``Backend`` on torch.

    Args:
        view: of an artifact; each of its parts has its products in fp32, bf16 or fp16.
        placed: constants of the artifact, where to compute; those of other views are shared.
        threads: of arithmetic on the CPU, during calls alone: torch's setting is as it was between them.
        capture: how lines are captured; None for CUDA graphs on CUDA, and not at all elsewhere.

    Attributes:
        keeps: entries of the rollout cache that some plan of the view can read.
        workspace: of the batch size under way.

    Raises:
        RuntimeUnavailableError: the device does not have the precision.
    """

    def __init__(self, view: View, placed: Placed, threads: int = 1, capture: Capture | None = None) -> None:
        self._view, self._manifest, self._threads = view, view.manifest, threads
        self.device = placed.device
        if capture is None and self.device.type == "cuda":
            capture = cuda_graphs(self.device)
        self._lines = Lines(capture)
        groups = self._manifest.groups
        dense = dense_plan(self._manifest.steps, len(groups))
        nothing = np.zeros(dense.shape, np.bool_)  # the first call of an episode is repaired
        plans = (dense, *view.schedules.values())
        known = {plan.tobytes(): plan for each in plans for plan in (each, without_illegal_reads(each, nothing))}
        self._own = {key: instructions_of(plan, groups) for key, plan in known.items()}
        self._named = set(self._own.values())
        self.keeps = readable_rollout(view)
        self._advances: dict[tuple[Correction | None, bool], tuple[Advance, MaskedUpdates | None]] = {}
        with self._settings():
            self._parts = Parts(view, placed)
            self.workspace = Workspace(self._parts, 1)
        self._some: dict[int, Workspace] = {}  # for streams of a batch that follow a plan of their own
        self._whole = False

    def lower(self, plan: PlanArray) -> Instructions:
        return self._own.get(plan.tobytes()) or instructions_of(plan, self._manifest.groups)

    def prepare(self, streams: int, plans: Sequence[Instructions] | None) -> None:
        """Make the workspace of a batch size."""
        self._pruned = plans is None
        one = plans is not None and len(set(plans)) == 1 and plans[0] in self._named
        # Whether a call is far outside has to be known before its loop.
        self._whole = one and self._lines.captures and self._view.artifact.envelope is None
        if self.workspace.streams == streams:
            return
        self._lines.forget()
        self._some.clear()
        with self._settings():
            self.workspace = Workspace(self._parts, streams)

    def start(self, call: Call) -> None:
        self._call = call
        with self._settings():
            self.workspace.load(call)
            self._advance = self._advance_of(call)
            if call.obs and not self._whole:
                self._lines.run("prologue", self.workspace.network.prologue)

    def condition(self) -> FloatArray:
        with self._settings():
            return np.asarray(self.workspace.network.condition().float().cpu().numpy(), dtype=np.float32)

    def logits(self) -> FloatArray:
        with self._settings():
            if self.device.type == "cuda":  # cuBLAS warns if it comes first in a thread, as in the one that prunes
                torch.cuda.current_stream(self.device).synchronize()
            return np.asarray(self.workspace.network.logits().float().cpu().numpy(), dtype=np.float32)

    def first_step(self) -> None:
        """Nothing: the line begins with it."""

    def other_steps(self, plans: Sequence[Instructions]) -> FloatArray:
        with self._settings():
            streams = by_plan(plans)
            if len(streams) == 1:
                self._run(self.workspace, plans[0], self._whole)
            else:
                self._apart(streams)
            return np.asarray(self.workspace.result.cpu().numpy()).copy()

    def _apart(self, streams: dict[Instructions, list[int]]) -> None:
        whole = self.workspace
        for plan, some in streams.items():
            if len(some) not in self._some:
                self._some[len(some)] = Workspace(self._parts, len(some))
            work, index = self._some[len(some)], torch.tensor(some, device=self.device)
            work.take(whole, index, plan)
            self._run(work, plan, False)
            work.give(whole, index, _kept(plan, self._call.keep))

    def _run(self, work: Workspace, plan: Instructions, whole: bool) -> None:
        """The loop on a workspace; the whole call where its plan was known before it began."""
        keep = self._call.keep
        for cell in (*np.flatnonzero(plan.rollout).tolist(), *_kept(plan, keep)):
            work.entry(cell)

        def line() -> None:
            if whole:
                work.network.prologue()
            work.call(plan, keep, self._advance)

        key = work.streams, whole, plan, keep.tobytes(), self._advance
        self._lines.run(key, line, at_once=self._pruned or plan in self._named)

    def _advance_of(self, call: Call) -> Advance:
        """The sampler's steps with the correction of a call; made once for each, and once for its prefixes."""
        key = call.correction, call.known is not None
        if key not in self._advances:
            spec, masked = self._manifest.spec, None
            advance = Advance(spec, call.correction, self.device)
            if call.known is not None:
                masked = MaskedUpdates(np.array(advance.updates.cpu().numpy()))
            self._advances[key] = advance, masked
        advance, masked = self._advances[key]
        if masked is not None and call.known is not None and masked.mask(call.known):
            advance.updates.copy_(torch.from_numpy(masked.updates))
        return advance

    @contextmanager
    def _settings(self) -> Iterator[None]:
        """The settings of torch that a call needs, which are the process's: as they were after it."""
        before = torch.get_num_threads()
        current = torch.cuda.device(self.device) if self.device.type == "cuda" else nullcontext()
        try:
            if before != self._threads:
                torch.set_num_threads(self._threads)
            with current, exact_arithmetic(self.device), fitting(self._view), torch.inference_mode():
                yield
        finally:
            if before != self._threads:
                torch.set_num_threads(before)


def _kept(plan: Instructions, keep: BoolArray) -> list[int]:
    """Computed cells whose residual goes into the rollout cache."""
    kept: list[int] = np.flatnonzero(plan.computed & keep).tolist()
    return kept


Line = Callable[[], None]
Capture = Callable[[Line], Line]
"""From a line to one that does the same again, quicker."""

MOST = 64
"""Lines that stay captured; the plans of a pruner are as many as it likes."""

WARM_UP = 2
"""Runs before a capture: libraries choose their kernels and take their memory in the first."""


class Lines:
    """Runs lines, captured or not."""

    def __init__(self, capture: Capture | None) -> None:
        self._capture = capture
        self._captured: OrderedDict[Hashable, Line] = OrderedDict()
        self._once: deque[Hashable] = deque(maxlen=MOST)  # of what came for the first time

    @property
    def captures(self) -> bool:
        """Whether lines are captured."""
        return self._capture is not None

    def run(self, key: Hashable, line: Line, at_once: bool = True) -> None:
        """Run a line.

        Args:
            key: of all that the line depends on beside the values of its tensors.
            at_once: capture it when it comes for the first time, and not for the second, as one that may never return.
        """
        if self._capture is None:
            return line()
        found = self._captured.get(key)
        if found is None and not (at_once or key in self._once):
            self._once.append(key)
            return line()
        if found is None:
            found = self._captured[key] = self._capture(line)
            if len(self._captured) > MOST:
                self._captured.popitem(last=False)
        self._captured.move_to_end(key)
        found()

    def forget(self) -> None:
        """Let go of everything that was captured: its tensors are no more."""
        self._captured.clear()
        self._once.clear()


def cuda_graphs(device: torch.device) -> Capture:
    """CUDA graphs of a device that share one pool of memory: they run one after the other.

    They are captured on a CUDA stream that computes nothing else. cuBLAS has scratch memory for each, which torch
    frees when somebody asks for that, as torch.compile does. So a graph has to have it from its own pool, as what is
    taken in a capture is. Pool and CUDA stream are done with when their graphs are: torch may still hold that memory.
    """
    alive: WeakSet[torch.cuda.CUDAGraph] = WeakSet()
    own: list[Any] = []

    def capture(line: Line) -> Line:
        for _ in range(WARM_UP):
            line()
        if not alive:
            own[:] = torch.cuda.graph_pool_handle(), torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        graph = torch.cuda.CUDAGraph()
        # By default whatever another thread waits for or allocates on the GPU meanwhile ends the capture.
        with torch.cuda.graph(graph, pool=own[0], stream=own[1], capture_error_mode="thread_local"):
            line()
        alive.add(graph)
        replay: Line = graph.replay
        return replay

    return capture
