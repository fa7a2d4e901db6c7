"""The seam ``ensemble``: each action is the weighted mean of what all chunks predicted for its tick."""

from collections import defaultdict
from math import exp

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ttscompile.errors import DeadlineMissedError, ExecutorError
from ttscompile.runtimes.executor import ExecutorSettings, GuardLimits
from ttscompile.runtimes.executor.timeline import Timeline, expand, splice

from .simulation import FakeClock, ScriptedPolicy, World


def weighted(predictions: list[np.ndarray], coefficient: float) -> np.ndarray:
    """By the definition: the oldest first, ``w_i = exp(-m i)``."""
    weights = np.exp(-coefficient * np.arange(len(predictions)))
    return np.asarray((weights[:, None] * np.stack(predictions)).sum(axis=0) / weights.sum())


@given(
    coefficient=st.sampled_from([0.0, 0.01, 0.5, -0.3, 9.0, -9.0]) | st.floats(-9.9, 9.9),
    chunks=st.lists(st.tuples(st.integers(0, 4), st.integers(1, 9), st.integers(0, 4)), min_size=1, max_size=12),
    ticks_per_step=st.sampled_from([1, 3]),
    interpolation=st.sampled_from(["hold", "linear"]),
    seed=st.integers(0, 99),
)
def test_it_is_the_weighted_mean_of_all_that_was_predicted_for_a_tick(
    coefficient: float, chunks: list[tuple[int, int, int]], ticks_per_step: int, interpolation: str, seed: int
) -> None:
    """Chunks start, and ticks are consumed, at random; what is scheduled is compared with the mean over all rows."""
    rng, timeline, start, seam = np.random.default_rng(seed), None, 0, 0
    predicted: dict[int, list[np.ndarray]] = defaultdict(list)
    for later, length, consumed in chunks:
        start += later
        rows = expand(rng.uniform(-5, 5, (length, 2)).astype(np.float32), ticks_per_step, interpolation)
        new = Timeline.of(start, rows, float(start))
        made = splice(timeline, new, seam, ensemble=coefficient)
        assert (made is None) == (new.end <= seam)
        if made is not None:
            if timeline is not None and timeline.end < made.start:  # nothing is made up for a gap
                predicted.clear()
            for tick in range(max(seam, start), new.end):
                predicted[tick].append(rows[tick - start])
            assert made.end == max(max(t for t in predicted if t >= seam) + 1, new.end)
            for tick in range(made.start, made.end):
                found = np.asarray(made.at(tick))
                np.testing.assert_allclose(found, weighted(predicted[tick], coefficient), atol=1e-5)
                assert made.chunks[tick - made.start] == len(predicted[tick])
            timeline = made
        seam += consumed


def test_a_case_by_hand() -> None:
    """The published formula: w = 1, e^-m, e^-2m, of which the oldest prediction has the first."""
    m, timeline = 0.5, None
    for start, value in ((0, 1.0), (1, 2.0), (2, 4.0)):
        timeline = splice(timeline, Timeline.of(start, np.full((4, 1), value, np.float32), start), 0, ensemble=m)
    assert timeline is not None
    second = (1 + 2 * exp(-m)) / (1 + exp(-m))
    third = (1 + 2 * exp(-m) + 4 * exp(-2 * m)) / (1 + exp(-m) + exp(-2 * m))
    fifth = (2 + 4 * exp(-m)) / (1 + exp(-m))
    np.testing.assert_allclose(timeline.rows[:, 0], [1, second, third, third, fifth, 4], rtol=1e-6)
    assert timeline.chunks.tolist() == [1, 2, 3, 3, 2, 1]
    assert timeline.observed.tolist() == [0, 1, 2, 2, 2, 2]  # of the newest that it was made from


def test_what_only_older_chunks_predicted_stays() -> None:
    """The guard may have left out a newer chunk's reserve."""
    old, new = (
        Timeline.of(start, np.full((n, 1), value, np.float32), start) for start, n, value in ((0, 9, 1), (2, 3, 3))
    )
    made = splice(old, new, 1, ensemble=0.0)
    assert made is not None
    assert (made.start, made.rows[:, 0].tolist()) == (1, [1, 2, 2, 2, 1, 1, 1, 1])
    assert made.observed.tolist() == [0, 2, 2, 2, 0, 0, 0, 0]
    replaced = splice(old, new, 1)
    assert replaced is not None
    assert replaced.end == 5


@pytest.mark.parametrize("coefficient", [0.0, 0.01, 2.0, -1.0])
@pytest.mark.parametrize("ticks_per_step", [1, 2])
def test_in_a_control_loop(coefficient: float, ticks_per_step: int) -> None:
    """As LeRobot's ACT does it, one action a call: what is played is the mean over all calls that were done by then."""
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.01}, reserve=4)
    rng, answers = np.random.default_rng(0), []

    def answer(obs: np.ndarray) -> np.ndarray:
        answers.append((obs[-1, 1], rng.uniform(-1, 1, (policy.predicted, 3)).astype(np.float32)))
        return answers[-1][1]

    policy.actions = answer
    settings = ExecutorSettings(
        policy_hz=10.0, seam="ensemble", horizon=1, ensemble_coefficient=coefficient, interpolation="linear"
    )
    with World(10.0 * ticks_per_step, settings, policy) as world:
        for _ in range(ticks_per_step):
            world.tick(action=False)
        world.observe()
        world.clock.advance(0.02)  # the chunk of each frame is there when its action is asked for
        for _ in range(30 * ticks_per_step):
            now = world.time
            made = world.executor.action()
            world.clock.advance(1 / world.hz - 0.02)
            tick, predictions = round((now - 0.02) * world.hz), []
            for seen, chunk in answers:
                at = tick - round(seen * world.hz)
                rows = expand(chunk[1:], ticks_per_step, "linear")
                predictions += [rows[at]] if at < len(rows) else []
            assert len(predictions) >= min(len(answers), 12 // ticks_per_step)
            np.testing.assert_allclose(made, weighted(predictions, coefficient), atol=1e-5)
            world.observe()
            world.clock.advance(0.02)
        counted = world.executor.statistics()
    assert counted.deadlines_missed == counted.holds == 0
    assert counted.action_age_ms is not None
    assert counted.action_age_ms.max == pytest.approx(20 + (1000 / world.hz) * (ticks_per_step - 1))


def test_it_is_much_smoother_than_to_replace() -> None:
    """A policy whose chunks differ by noise alone: the mean of eleven has a third of it."""

    def roughness(seam: str) -> float:
        policy, rng = ScriptedPolicy(FakeClock(), {"dense": 0.02}, reserve=4), np.random.default_rng(0)
        policy.actions = lambda _: rng.normal(0, 1, (policy.predicted, 3)).astype(np.float32)
        settings = ExecutorSettings(seam=seam, horizon=1, ensemble_coefficient=0.0)
        with World(settings=settings, policy=policy) as world:
            return float(np.diff(world.run(80)[12:], axis=0).std())

    assert roughness("ensemble") < 0.35 * roughness("replace")


def test_the_guard_looks_at_what_the_means_do() -> None:
    """Every chunk stands still, but not all in one place: the step from mean to mean is compared with the limit."""
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.02}, reserve=4)
    policy.actions = lambda obs: np.full((policy.predicted, 3), 0.0 if obs[-1, 1] < 1 else 10.0)

    def drive(limit: float) -> str | None:
        guard = GuardLimits(low=-100.0, high=100.0, max_step=limit)
        settings = ExecutorSettings(seam="ensemble", horizon=1, ensemble_coefficient=0.0, guard=guard, max_hold=0)
        policy.clock, policy.calls = FakeClock(), []
        with World(settings=settings, policy=policy) as world:
            world.begin()
            try:
                made = [world.tick()[0] for _ in range(30)]
            except DeadlineMissedError:
                return world.executor.statistics().last_refusal
            assert made[-1] == 10
            return None

    assert drive(10.0) is None
    assert "its step of" in str(drive(0.5))


@pytest.mark.parametrize("value", ["0.01", 10, -10, float("nan"), True, None])
def test_the_coefficient_is_checked(value: object) -> None:
    with pytest.raises(
        ExecutorError, match=f"ensemble_coefficient must be a number, between -10 and 10; found {value!r}"
    ):
        ExecutorSettings(ensemble_coefficient=value)  # type: ignore[arg-type]
