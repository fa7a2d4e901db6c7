"""Episodes driven by a policy, several at once, on numbered seeds and with numbered noise."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from environments import Array, Environment, Frame
from variants import Variant, seeded_noise

import ttscompile
from ttscompile.errors import TtscompileError
from ttscompile.runtimes.queues import Queues


@dataclass(frozen=True)
class Episode:
    """What happened in one episode.

    Attributes:
        seed: of the initial state and of the noise.
        task: what had to be done; empty where there is one task only.
        windows: by key ``[calls, To, ...]``, what the policy observed at each call, in order.
        actions: ``[S, Da]``, the executed ones.
        scores: ``[S]``, the score so far, after each action.
        success: whether the task was solved.
        measures: further figures, as the environment names them.
        sparsity: share of the cells that were reused in each call, ``[calls]``; empty when the policy makes no reports.
        flops: of each call, prologue and pruner included; likewise.
        legalised: cells of each call that had to be replaced; likewise.
    """

    seed: int
    task: str
    windows: Mapping[str, Array]
    actions: Array
    scores: Array
    success: bool
    measures: Mapping[str, float]
    sparsity: tuple[float, ...] = ()
    flops: tuple[float, ...] = ()
    legalised: tuple[int, ...] = ()

    @property
    def score(self) -> float:
        """0 to 1, as the environment counts it."""
        return float(self.scores[-1])

    @property
    def calls(self) -> int:
        """Of the policy."""
        return len(next(iter(self.windows.values())))


class EpisodeCache(Protocol):
    """Keeps the episodes of one policy with one plan in one environment."""

    def read(self, seed: int) -> Episode | None:
        """The episode of a seed, if it is kept."""

    def write(self, episode: Episode) -> None:
        """Keep an episode."""


@dataclass(frozen=True)
class Rollout:
    """Episodes of one policy.

    Attributes:
        episodes: in the order of the seeds.
        call_ms: wall time of each (batched) call that was made, milliseconds.
    """

    episodes: tuple[Episode, ...]
    call_ms: tuple[float, ...]

    @property
    def sparsity(self) -> tuple[float, ...]:
        """Of all calls."""
        return tuple(value for episode in self.episodes for value in episode.sparsity)

    @property
    def flops(self) -> tuple[float, ...]:
        """Of all calls."""
        return tuple(value for episode in self.episodes for value in episode.flops)

    @property
    def legalised(self) -> tuple[int, ...]:
        """Of all calls."""
        return tuple(value for episode in self.episodes for value in episode.legalised)


def stacked(rows: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """By key, the rows' arrays under one more axis."""
    return {key: np.stack([row[key] for row in rows]) for key in rows[0]}


class Recorder:
    """An environment, and what happened in it since its reset: makes an ``Episode`` of it."""

    def __init__(self, environment: Environment, seed: int) -> None:
        environment.reset(seed)
        self.environment, self._seed = environment, seed
        self.frame: Frame = environment.observe()
        self.windows: list[Mapping[str, Array]] = []
        self._actions: list[Array] = []
        self._scores: list[float] = []

    @property
    def steps(self) -> int:
        """Actions so far."""
        return len(self._actions)

    def step(self, action: Array) -> None:
        """Take one action."""
        self.environment.step(action)
        self._actions.append(action)
        self._scores.append(self.environment.score)

    def look(self) -> Frame:
        """The frame now; once the episode is done, the last one that was looked at."""
        if not self.environment.done:
            self.frame = self.environment.observe()
        return self.frame

    def episode(self, figures: Sequence[tuple[float, float, int]] = ()) -> Episode:
        """So far; ``figures`` are sparsity, FLOPs and legalised cells of each call."""
        sparsity, flops, legalised = zip(*figures, strict=True) if figures else ((), (), ())
        return Episode(
            seed=self._seed,
            task=self.environment.task,
            windows=stacked(self.windows),
            actions=np.stack(self._actions),
            scores=np.array(self._scores),
            success=self.environment.success,
            measures=dict(self.environment.measures),
            sparsity=sparsity,
            flops=flops,
            legalised=legalised,
        )


def run_batch(
    make: Callable[[], Environment],
    variant: Variant,
    seeds: Sequence[int],
    on_call: Callable[[int], None] | None = None,
) -> Rollout:
    """Run one episode a seed in lockstep, from the policy's ``reset()`` until all are done.

    The streams of a batch stay the same until the end, because the policy keeps caches for each: an episode that is
    done repeats its last frame, and what the policy makes of that is thrown away.

    Args:
        make: an environment of its own for each episode.
        variant: policy and plan.
        seeds: one an episode.
        on_call: told the number of unfinished episodes after each call.

    Returns:
        The episodes, in the order of the seeds.

    Raises:
        TtscompileError: the policy observes or does something else than what the environment offers.
    """
    streams = [Recorder(make(), seed) for seed in seeds]
    specs = variant.policy.info.observation
    _require_fit(variant, streams[0])
    span = max(spec.frames or 1 for spec in specs.values())
    queues = Queues(specs)

    def look() -> dict[str, Array]:
        frames = queues.after(stacked([one.look() for one in streams]))
        queues.keep(frames)
        return queues.observation(frames)

    figures: list[list[tuple[float, float, int]]] = [[] for _ in seeds]
    call_ms: list[float] = []
    variant.policy.reset()
    windows = look()
    while not all(one.environment.done for one in streams):
        active = [i for i, one in enumerate(streams) if not one.environment.done]
        noise = seeded_noise(variant.noise, seeds, len(call_ms))
        started = time.perf_counter()
        chunks = variant.policy.predict_action(windows, noise=noise, plan=variant.plan)["action"]
        call_ms.append(1000 * (time.perf_counter() - started))
        report = getattr(variant.policy, "last_report", None)
        for i in active:
            if report is not None:
                reused = float(np.mean(report.plan[i] != ttscompile.Source.COMPUTE))
                figures[i].append((reused, float(report.flops[i]), int(report.legalised[i])))
            streams[i].windows.append({key: array[i] for key, array in windows.items()})
        length = chunks.shape[1]
        for number in range(length):
            for i in active:
                if not streams[i].environment.done:
                    streams[i].step(chunks[i, number])
            if number >= length - span:  # nobody sees the frames before these
                windows = look()
        if on_call is not None:
            on_call(sum(not one.environment.done for one in streams))
    episodes = tuple(one.episode(calls) for one, calls in zip(streams, figures, strict=True))
    return Rollout(episodes, tuple(call_ms))


def _require_fit(variant: Variant, stream: Recorder) -> None:
    info, environment = variant.policy.info, stream.environment
    observes, offers = sorted(info.observation), sorted(stream.frame)
    gives, takes = [info.action.action_dim], list(environment.rest().shape)
    if not set(observes) <= set(offers) or gives != takes:
        policy = f"{variant.label} observes {observes} and gives actions of shape {gives}"
        world = f"{environment.title} offers {offers} and takes {takes}"
        raise TtscompileError(f"{policy}; {world}. Choose the policy's environment with --environment.")


def run_episodes(
    make: Callable[[], Environment],
    variant: Variant,
    seeds: Sequence[int],
    batch: int,
    on_done: Callable[[int], None] | None = None,
    cache: EpisodeCache | None = None,
) -> Rollout:
    """Run one episode a seed, ``batch`` at a time.

    Args:
        make: as in ``run_batch``.
        variant: as in ``run_batch``.
        seeds: one an episode.
        batch: episodes in lockstep.
        on_done: told the number of finished episodes, after each call.
        cache: where episodes of this variant were kept, and are; None for nowhere.

    Returns:
        All episodes, in the order of the seeds.
    """
    known = {} if cache is None else {seed: episode for seed in seeds if (episode := cache.read(seed)) is not None}
    missing = [seed for seed in seeds if seed not in known]
    parts: list[Rollout] = []
    for start in range(0, len(missing), batch):
        some = missing[start : start + batch]

        def finished(running: int, first: int = len(known), size: int = len(some)) -> None:
            if on_done is not None:
                on_done(first + size - running)

        parts.append(run_batch(make, variant, some, finished))
        for episode in parts[-1].episodes:
            known[episode.seed] = episode
            if cache is not None:
                cache.write(episode)
    if on_done is not None:
        on_done(len(seeds))
    return Rollout(
        episodes=tuple(known[seed] for seed in seeds), call_ms=tuple(ms for part in parts for ms in part.call_ms)
    )


def action_errors(variant: Variant, episodes: Sequence[Episode]) -> Array:
    """How far a policy's actions are from those of episodes, call by call, on their observations and with their noise.

    Args:
        variant: a policy and its plan; observations and actions are those of the policy that the episodes are of.
        episodes: each is a stream, and caches are carried from call to call.

    Returns:
        ``[episodes, calls of the longest]``, mean absolute differences in the units of the actions; NaN after an end.
    """
    seeds, calls = [episode.seed for episode in episodes], [episode.calls for episode in episodes]
    errors = np.full((len(episodes), max(calls)), np.nan)
    variant.policy.reset()
    for number in range(max(calls)):
        rows = [min(number, count - 1) for count in calls]  # one that has ended repeats its last window
        windows = stacked([{k: a[row] for k, a in e.windows.items()} for e, row in zip(episodes, rows, strict=True)])
        noise = seeded_noise(variant.noise, seeds, number)
        made = variant.policy.predict_action(windows, noise=noise, plan=variant.plan)["action"]
        for i in np.flatnonzero(number < np.array(calls)).tolist():
            taken = episodes[i].actions[number * made.shape[1] : (number + 1) * made.shape[1]]  # the last chunk is cut
            errors[i, number] = np.abs(made[i, : len(taken)] - taken).mean()
    return errors
