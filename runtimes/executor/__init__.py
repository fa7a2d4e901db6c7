"""The asynchronous executor: a control loop always has the action for now, while the next chunk is computed.

Everything that decides is a state machine without clock or thread. ``executor`` and the thread of ``worker`` drive it:

- ``window``: frames in, observation windows out.
- ``timeline``: actions by control tick, and how chunks join; ``schedule``: those of one episode.
- ``feasibility``: whether a policy keeps up, and which plan runs under pressure.
- ``guard``: what a chunk must be before it is executed, and whether the policy has stopped moving.
- ``state``: all of these together, and when the next call starts.

``settings`` and ``measure`` are what they begin with, ``statistics`` what happened; ``shadow`` is a compiled policy
beside the original that acts.
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
