"""The rollout cache under the executor: late calls, dropped chunks and resets leave what the definition leaves."""

import random
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.plans import store_schedules
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile import AsyncExecutor, ExecutorSettings, GuardLimits, Source
from ttscompile.errors import DeadlineMissedError
from ttscompile.runtimes.executor import ExecutorStatistics
from ttscompile.runtimes.policy import CompiledPolicy

from .simulation import FakeClock

HZ, TYPICAL = 10.0, 0.1
PLAN = "tts"


@pytest.fixture(scope="module")
def pruned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A toy whose default plan is its pruner's, which reads earlier calls; eight actions a chunk."""
    artifact = written_artifact(toy_program(horizon=9), tmp_path_factory.mktemp("pruned") / "artifact")
    store_schedules(artifact.path, dict(artifact.pruner), {}, PLAN, {"learned": ["schedule"]})
    return artifact.path


class Slow:
    """A compiled policy whose calls take a scripted time.

    Attributes:
        episodes: of each episode, what every call was given and what it gave.
    """

    def __init__(self, policy: CompiledPolicy, clock: FakeClock, seed: int) -> None:
        self.info, self._policy, self.clock, self._chance = policy.info, policy, clock, random.Random(seed)
        self.episodes: list[list[tuple[Mapping[str, Any], ttscompile.Noise, str, np.ndarray]]] = [[]]
        self.read, self._waits = 0, threading.Condition()

    def reset(self, seed: int | None = None) -> None:
        self._policy.reset()
        self.episodes.append([])

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str) -> Mapping[str, Any]:
        noise = drawn(self._policy, sum(map(len, self.episodes)))
        made = self._policy.predict_action(obs_dict, noise=noise, plan=plan)
        assert self._policy.last_report is not None
        self.read += int((self._policy.last_report.plan == Source.ROLLOUT).sum())
        obs = {key: np.array(one) for key, one in obs_dict.items()}
        self.episodes[-1].append((obs, noise, plan, made["action_pred"]))
        until = self.clock.now() + TYPICAL * self._chance.choice([1, 1, 1, 20])  # the last is late for its chunk
        with self._waits:
            while self.clock.now() < until:
                self.clock.wait(self._waits, until - self.clock.now())
        return made


def driven(policy: Slow, seed: int, resets: float = 0.0, **settings: Any) -> ExecutorStatistics:
    """What a loop of 250 ticks counts, after a share of which the executor is reset."""
    clock, chance, draw = policy.clock, random.Random(seed), np.random.default_rng(seed)
    own, latencies = ExecutorSettings(n_obs_steps=1, **settings), {PLAN: TYPICAL, "dense": TYPICAL}
    executor = AsyncExecutor(policy, HZ, own, clock=clock, latencies=latencies)
    shape = next(iter(policy.info.observation.values())).shape
    clock.settle()
    try:
        for _ in range(250):
            executor.observe({"obs": draw.standard_normal(shape[-1]).astype(np.float32)})
            clock.settle()
            if executor.ready:
                with suppress(DeadlineMissedError):
                    executor.action()
            clock.advance(1 / HZ)
            if chance.random() < resets:
                executor.reset()  # a call under way is not waited for: what it gives is dropped
                clock.settle()
    finally:
        clock.free()
        executor.close()
    return executor.statistics()


def drawn(policy: CompiledPolicy, number: int) -> ttscompile.Noise:
    """The noise of the call of this number."""
    draw, (horizon, channels) = np.random.default_rng(number), policy.info.original_sample
    steps = draw.standard_normal((policy.info.K, 1, horizon, channels), dtype=np.float32)
    return ttscompile.Noise(draw.standard_normal((1, horizon, channels), dtype=np.float32), steps)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_late_calls_dropped_chunks_and_resets(pruned: Path, seed: int) -> None:
    """Every call is answered as by a policy that made the same calls of this episode, and no others."""
    policy = Slow(ttscompile.load(pruned), FakeClock(), seed)
    counted = driven(policy, seed, resets=0.03)
    assert counted.chunks_discarded > 3
    assert counted.chunks_refused > 3  # by the guard: its bounds are those of the toy's data
    assert counted.latency_ms is not None
    assert counted.latency_ms.max >= 20 * TYPICAL
    assert policy.read > 20
    assert len(policy.episodes) > 3
    assert max(map(len, policy.episodes)) > 3
    require_alone(pruned, policy)


@pytest.mark.slow
def test_a_call_after_a_stall_goes_on_from_nothing(pruned: Path) -> None:
    """With a reach that no action leaves; what the calls before computed is read neither by this call nor later."""
    policy, guard = Slow(ttscompile.load(pruned), FakeClock(), 0), GuardLimits(low=-1e9, high=1e9)
    counted = driven(policy, 0, tiers=(PLAN,), stall_after=2.0, stall_range=1e9, guard=guard)
    first, *others = policy.episodes[1:]  # the first reset is before the first call
    assert len(others) == counted.stalls > 2
    assert [episode[0][2] for episode in others] == ["dense"] * len(others)
    assert {plan for episode in (first, *others) for _, _, plan, _ in episode[1:]} == {PLAN}
    require_alone(pruned, policy)


def require_alone(pruned: Path, policy: Slow) -> None:
    """Require every episode to be what another policy answers to the same calls."""
    for episode in policy.episodes:
        alone = ttscompile.load(pruned)
        for obs, noise, plan, made in episode:
            assert np.array_equal(alone.predict_action(obs, noise=noise, plan=plan)["action_pred"], made)
