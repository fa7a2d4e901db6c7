"""The asynchronous executor: a control loop always has the action for now, while the next chunk is computed.

Everything that decides is a state machine without clock or thread, driven by ``executor``, which has the one thread:

- ``window``: frames in, observation windows out.
- ``schedule``: actions by control tick, and how chunks join.
- ``feasibility``: whether a policy keeps up, when its next call must start, and which plan runs under pressure.
- ``guard``: what a chunk must be before it is executed.
- ``stall``: whether the policy has stopped moving.
- ``state``: all of these together.
- ``statistics``, ``trace``: what happened.
- ``shadow``: a compiled policy beside the original that acts.
"""

from .executor import AsyncExecutor
from .feasibility import Feasibility
from .guard import GuardLimits
from .measure import Clock, MonotonicClock
from .settings import ExecutorSettings
from .shadow import Shadow, ShadowReport
from .statistics import ExecutorStatistics

__all__ = [
    "AsyncExecutor",
    "Clock",
    "ExecutorSettings",
    "ExecutorStatistics",
    "Feasibility",
    "GuardLimits",
    "MonotonicClock",
    "Shadow",
    "ShadowReport",
]
