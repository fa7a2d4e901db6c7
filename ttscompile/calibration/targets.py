"""The calls of a calibration, and what the dense policy answers to them: computed once, and saved as it grows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from ..core.spec import PolicySpec
from ..trajectories.episodes import Episode
from .calls import Calls, Split, prepare_calls, sample_calls
from .execute import Executor, workers
from .progress import Bar
from .state import StateFile
from .task import Clock

REPEATS = 8
"""How often an observation may be learned from, each time with another noise."""

SHARE = 0.5
"""Share of the time limit after which no more targets are made than there have to be."""

TARGETS_AT_ONCE = 16
"""Dense calls that go through the loop together, on one core; after a round of these the state is saved."""


def with_targets(
    executor: Executor, name: str, calls: Calls, least: int, state: StateFile, clock: Clock, bar: Bar
) -> Calls:
    """The calls with what the dense policy answers to them; the first of them where the time does not do for all.

    Args:
        executor: runs the policy.
        name: what the calls are called in the state.
        calls: calls whose targets are not known yet.
        least: as many are needed whatever the time.
        state: remembers what was computed.
        clock: with the limit of the calibration.
        bar: shows the progress.
    """
    known = state.get("targets").get(name)
    sample = calls.initial.shape[1:]
    path = torch.empty(0, executor.model.steps, *sample)
    if known is not None:
        with state.reading():
            path = torch.cat([path, torch.from_numpy(known)])
    bar.stage(f"dense, {name}", calls.count, len(path))
    rounds, key = dense_rounds(executor, calls, len(path)), f"{name} targets"
    # A calibration that was interrupted later goes on with as many as it had then.
    count = min(calls.count, int(state.progress.get(key, calls.count)))
    while len(path) < count and (len(path) < least or clock.elapsed() < SHARE * clock.limit):
        path = torch.cat([path, next(rounds)])
        state.put("targets", {**state.get("targets"), name: path.numpy()})
        state.progress["seconds"] = clock.elapsed()
        state.save()
        bar.update(len(path), "", clock.left())
    state.progress[key] = len(path)
    if len(path) < calls.count:
        calls = executor.select(calls, np.arange(len(path)))
    return replace(calls, path=path)


def dense_rounds(executor: Executor, calls: Calls, begin: int = 0) -> Iterator[torch.Tensor]:
    """What the dense policy answers to calls, from number ``begin`` on, a round of all workers at a time.

    Yields:
        Paths ``[n, K, T, D]``, in order.
    """
    at_once = torch.get_num_threads() * TARGETS_AT_ONCE
    while begin < calls.count:
        end = min(begin + at_once, calls.count)
        parts = [np.arange(i, min(i + TARGETS_AT_ONCE, end)) for i in range(begin, end, TARGETS_AT_ONCE)]
        with workers() as pool:
            found = list(pool.map(lambda part: executor.run_dense(executor.select(calls, part)), parts))
        begin = end
        yield torch.cat(found)


def draw_calls(
    executor: Executor, spec: PolicySpec, episodes: Sequence[Episode], split: Split, limit: int, judged: int, seed: int
) -> dict[str, Calls]:
    """The calls to learn from and those that plans are judged on, without targets.

    Args:
        executor: runs the policy.
        spec: the specification of the policy.
        episodes: all recorded episodes.
        split: which episodes are for what.
        limit: calls to learn from, at most.
        judged: calls to judge on, at most.
        seed: the seed of the choice of calls and of their noise.

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
