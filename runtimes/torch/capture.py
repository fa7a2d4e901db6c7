"""The one place where it matters whether calls are captured: lines are run as they are, or captured once and replayed.

A *line* is a call, or a part of one, between tensors that stay where they are: a function of no arguments that reads
some of them and writes others, never looks at their values, and does the same operations every time. On CUDA that is
what a graph can be captured of. Everywhere else it simply runs.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable

import torch

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

    @property
    def captures(self) -> bool:
        """Whether lines are captured."""
        return self._capture is not None

    def run(self, key: Hashable, line: Line) -> None:
        """Run a line.

        Args:
            key: of all that the line depends on beside the values of its tensors; None not to capture it.
        """
        if self._capture is None or key is None:
            line()
            return
        found = self._captured.get(key)
        if found is None:
            found = self._captured[key] = self._capture(line)
            if len(self._captured) > MOST:
                self._captured.popitem(last=False)
        self._captured.move_to_end(key)
        found()

    def forget(self) -> None:
        """Let go of everything that was captured: its tensors are no more."""
        self._captured.clear()


def cuda_graphs(device: torch.device) -> Capture:
    """CUDA graphs of a device that share one pool of memory: they run one after the other.

    Each is captured on a stream of that device; torch's own for captures is of whichever device had the first.
    """
    pool = torch.cuda.graph_pool_handle()

    def capture(line: Line) -> Line:
        side: torch.cuda.Stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        side.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(side):
            for _ in range(WARM_UP):
                line()
        torch.cuda.current_stream(device).wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=pool, stream=side):
            line()
        replay: Line = graph.replay
        return replay

    return capture
