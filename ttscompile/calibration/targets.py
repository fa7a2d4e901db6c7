"""The calls of a calibration, and what the dense policy answers to them: computed once, and saved as it grows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ..config import PolicySpec
from ..trajectories import Episode
from .calls import Calls, Split, prepare_calls, sample_calls
from .clock import Clock
from .execute import Executor
from .progress import Bar
from .state import StateFile
from .workers import workers

REPEATS = 8
"""How often an observation may be learned from, each time with another noise."""

TARGETS_AT_ONCE = 16
"""Dense calls that go through the loop together, on one core; after a round of these the state is saved."""


def with_targets(executor: Executor, name: str, calls: Calls, state: StateFile, clock: Clock, bar: Bar) -> Calls:
    """The calls with what the dense policy answers to them.

    Args:
        executor: of the policy.
        name: of the calls in the state.
        calls: without targets.
        state: remembers what was computed.
        clock: only counts: targets are needed whatever the time.
        bar: shows the progress.
    """
    known = state.get("targets").get(name)
    sample = calls.initial.shape[1:]
    path = torch.empty(0, executor.model.steps, *sample) if known is None else torch.from_numpy(known)
    bar.stage(f"dense, {name}", calls.count, len(path))
    while len(path) < calls.count:
        with workers() as some:
            begins = range(len(path), min(len(path) + some.count * TARGETS_AT_ONCE, calls.count), TARGETS_AT_ONCE)
            parts = [np.arange(i, min(i + TARGETS_AT_ONCE, calls.count)) for i in begins]
            path = torch.cat([path, *some.map(lambda p: executor.run_dense(executor.selector.calls(calls, p)), parts)])
        state.put("targets", {**state.get("targets"), name: path.numpy()})
        state.progress["seconds"] = clock.elapsed()
        state.save()
        bar.update(len(path), "", clock.left())
    return calls.answered(path)


def draw_calls(
    executor: Executor, spec: PolicySpec, episodes: Sequence[Episode], split: Split, limit: int, judged: int, seed: int
) -> dict[str, Calls]:
    """The calls to learn from and those that plans are judged on, without targets.

    Args:
        executor: of the policy.
        spec: of the policy.
        episodes: all of them.
        split: of the episodes.
        limit: calls to learn from, at most.
        judged: calls to judge on, at most.
        seed: of calls and noise.

    Returns:
        ``calibration`` and ``validation``.
    """
    sets = {}
    for number, (name, chosen, count) in enumerate(
        (("calibration", split.calibration, limit), ("validation", split.validation, judged))
    ):
        drawn = sample_calls(episodes, chosen, count, seed, REPEATS if name == "calibration" else 1)
        sets[name] = prepare_calls(executor.model, spec, episodes, drawn, (seed, 2, number))
    return sets
