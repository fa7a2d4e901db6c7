"""Episodes of Push-T driven by a policy, several at once, on numbered seeds and with numbered noise."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from environment import SUCCESS_COVERAGE, Float64Array, FloatArray, PushT

import ttscompile

Plan: TypeAlias = str | npt.NDArray[np.int8]
"""``dense``, the name of a plan in the artifact, or a matrix ``[K, blocks]``."""


class Policy(Protocol):
    """What ``ttscompile.load`` returns, as far as an episode needs it."""

    def reset(self) -> None:
        """A new episode."""

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: ttscompile.Noise | None = None, plan: Plan | None = None
    ) -> Mapping[str, Any]:
        """Windows ``[N, To, Do]`` in, ``{"action": [N, Ta, 2]}`` out; without a plan the policy's default."""


@dataclass(frozen=True)
class NoiseShape:
    """Sizes of the random numbers of one call of one stream.

    Attributes:
        steps: K.
        sample: ``(T, D)``.
        stochastic: whether the sampler draws noise at its steps.
    """

    steps: int
    sample: tuple[int, int]
    stochastic: bool


@dataclass(frozen=True)
class Episode:
    """What happened in one episode.

    Attributes:
        seed: of the initial state and of the noise.
        windows: float32 ``[calls, 2, 20]``, the observation of each call, in order.
        states: ``[S + 1, 5]``.
        targets: ``[S, 2]``, the executed actions.
        coverages: ``[S]``, share of the goal covered after each action.
        sparsity: share of the cells that were reused in each call, ``[calls]``; empty when the policy makes no reports.
        flops: of each call, prologue and pruner included; likewise.
        legalised: cells of each call that had to be replaced; likewise.
    """

    seed: int
    windows: FloatArray
    states: Float64Array
    targets: Float64Array
    coverages: Float64Array
    sparsity: tuple[float, ...] = ()
    flops: tuple[float, ...] = ()
    legalised: tuple[int, ...] = ()

    @property
    def best_coverage(self) -> float:
        """The largest share of the goal that was covered."""
        return float(self.coverages.max())

    @property
    def score(self) -> float:
        """The original's reward: best coverage as a share of what counts as success, at most 1."""
        return min(max(self.best_coverage / SUCCESS_COVERAGE, 0.0), 1.0)

    @property
    def success(self) -> bool:
        """Whether the goal was covered to more than ``SUCCESS_COVERAGE``."""
        return self.best_coverage > SUCCESS_COVERAGE


class EpisodeCache(Protocol):
    """Keeps the episodes of one policy with one plan."""

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


def seeded_noise(shape: NoiseShape, seeds: Sequence[int], call: int) -> ttscompile.Noise:
    """The noise of the ``call``-th call of each episode.

    A function of seed and call only: any two policies see the same numbers, in whatever batches they run. Policies
    with another number of steps share the initial noise.

    Args:
        shape: sizes.
        seeds: one a stream, not negative.
        call: number of the call in the episode.

    Returns:
        ``initial [N, T, D]`` and ``steps [K, N, T, D]`` (None for a deterministic sampler), float32.
    """
    generators = [np.random.default_rng([seed, call]) for seed in seeds]
    initial = np.stack([g.standard_normal(shape.sample, dtype=np.float32) for g in generators])
    if not shape.stochastic:
        return ttscompile.Noise(initial, None)
    sizes = (shape.steps, *shape.sample)
    return ttscompile.Noise(initial, np.stack([g.standard_normal(sizes, dtype=np.float32) for g in generators], axis=1))


def run_batch(
    policy: Policy,
    seeds: Sequence[int],
    shape: NoiseShape,
    plan: Plan | None = None,
    on_call: Callable[[int], None] | None = None,
) -> Rollout:
    """Run one episode a seed in lockstep, from ``policy.reset()`` until all are done.

    The streams of a batch stay the same until the end, because the policy keeps caches for each: an episode that is
    done repeats its last observation, and what the policy makes of that is thrown away.

    Args:
        policy: whose ``predict_action`` takes ``noise`` and, if a plan is given, ``plan``.
        seeds: one an episode.
        shape: sizes of the policy's noise.
        plan: as in ``predict_action``; None for the policy's default.
        on_call: told the number of unfinished episodes after each call.

    Returns:
        The episodes, in the order of the seeds.
    """
    environments = [PushT() for _ in seeds]
    current = [environment.reset(seed) for environment, seed in zip(environments, seeds, strict=True)]
    windows: list[list[FloatArray]] = [[] for _ in seeds]
    figures: list[list[tuple[float, float, int]]] = [[] for _ in seeds]
    call_ms: list[float] = []
    policy.reset()
    while not all(environment.done for environment in environments):
        active = [i for i, environment in enumerate(environments) if not environment.done]
        noise = seeded_noise(shape, seeds, len(call_ms))
        started = time.perf_counter()
        actions = policy.predict_action({"obs": np.stack(current)}, noise=noise, plan=plan)["action"]
        call_ms.append(1000 * (time.perf_counter() - started))
        report = getattr(policy, "last_report", None)
        for i in active:
            if report is not None:
                reused = float(np.mean(report.plan[i] != ttscompile.Source.COMPUTE))
                figures[i].append((reused, report.flops[i], report.legalised[i]))
            windows[i].append(current[i])
            current[i] = environments[i].execute(actions[i])
        if on_call is not None:
            on_call(sum(not environment.done for environment in environments))
    return Rollout(
        episodes=tuple(
            Episode(
                seed=seed,
                windows=np.stack(rows),
                states=np.stack(environment.states),
                targets=np.stack(environment.targets),
                coverages=np.array(environment.coverages),
                sparsity=tuple(reused for reused, _, _ in calls),
                flops=tuple(flops for _, flops, _ in calls),
                legalised=tuple(legalised for _, _, legalised in calls),
            )
            for seed, rows, environment, calls in zip(seeds, windows, environments, figures, strict=True)
        ),
        call_ms=tuple(call_ms),
    )


def run_episodes(
    policy: Policy,
    seeds: Sequence[int],
    shape: NoiseShape,
    batch: int,
    plan: Plan | None = None,
    on_done: Callable[[int], None] | None = None,
    cache: EpisodeCache | None = None,
) -> Rollout:
    """Run one episode a seed, ``batch`` at a time.

    Args:
        policy: as in ``run_batch``.
        seeds: one an episode.
        shape: sizes of the policy's noise.
        batch: episodes in lockstep.
        plan: as in ``run_batch``.
        on_done: told the number of finished episodes, after each call.
        cache: where episodes of this policy and plan were kept, and are; None for nowhere.

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

        parts.append(run_batch(policy, some, shape, plan, finished))
        for episode in parts[-1].episodes:
            known[episode.seed] = episode
            if cache is not None:
                cache.write(episode)
    if on_done is not None:
        on_done(len(seeds))
    return Rollout(
        episodes=tuple(known[seed] for seed in seeds),
        call_ms=tuple(ms for part in parts for ms in part.call_ms),
    )
