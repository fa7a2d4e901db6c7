"""Feasibility, tiers and the guard: decisions without state of the world."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ttscompile import Affine, ChunkSpec
from ttscompile.core.spec import Switch
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.executor.feasibility import MOST_PATIENCE, Feasibility, LatencyWindow, Tiers
from ttscompile.runtimes.executor.guard import Guard, GuardLimits

from .simulation import NORMALIZER, rows


def test_the_arithmetic_of_push_t() -> None:
    at_10 = Feasibility(0.3, 10, 10, 8, 1)
    assert at_10.feasible
    assert at_10.needed == pytest.approx(0.8)
    assert at_10.max_latency == pytest.approx(0.3)
    assert not Feasibility(0.301, 10, 10, 8, 1).feasible
    at_50 = Feasibility(0.04, 50, 50, 8, 1)
    assert at_50.max_latency == pytest.approx(0.06)
    assert at_50.explain() == ("frame period 20 + 2 x latency 40 + margin 20 = 120 ms <= 160 ms = 8 actions at 50 Hz")
    assert at_50.max_policy_hz == pytest.approx(75)
    assert Feasibility(0.04, 75, 75, 8, 1).feasible
    assert not Feasibility(0.04, 76, 76, 8, 1).feasible
    assert at_50.to_json()["feasible"] is True


def test_calls_last_no_longer_than_the_prefix_that_a_policy_was_trained_with() -> None:
    """The action of a call's first tick is the first of its prefix: three last two ticks, up to the third."""
    at_50 = Feasibility(0.04, 50, 50, 8, 1, reserve_steps=7, prefix_steps=3)
    assert at_50.feasible
    assert at_50.max_latency == pytest.approx(0.04)
    slow = Feasibility(0.041, 50, 50, 8, 1, reserve_steps=7, prefix_steps=3)
    assert not slow.feasible
    assert slow.explain() == (
        "latency 41 ms > 40 ms, of a prefix of 3 actions at 50 Hz, the longest that the policy was trained with"
    )
    assert Feasibility(0.041, 50, 50, 8, 1, reserve_steps=7).feasible


def test_what_is_predicted_beyond_what_is_executed_lets_calls_take_longer() -> None:
    """Push-T predicts 15 actions from the observation on, and executes 8."""
    at_50 = Feasibility(0.04, 50, 50, 8, 1, reserve_steps=7)
    assert at_50.max_latency == pytest.approx(0.13)  # with its double, a frame and a tick, 15 actions
    assert at_50.explain() == ("frame period 20 + 2 x latency 40 + margin 20 = 120 ms <= 300 ms = 15 actions at 50 Hz")
    slow = Feasibility(0.131, 50, 50, 8, 1, reserve_steps=7)
    assert not slow.feasible
    assert slow.explain().endswith("= 302 ms > 300 ms = 15 actions at 50 Hz")
    long = Feasibility(0.04, 50, 50, 8, 1, reserve_steps=50)
    assert long.max_latency == pytest.approx(0.16)  # a call is done when the next one starts
    slow = Feasibility(0.161, 50, 50, 8, 1, reserve_steps=50)
    assert not slow.feasible
    assert slow.explain() == "latency 161 ms > 160 ms = 8 actions at 50 Hz, to the next call"
    assert "latency 12345 + margin 20 = 24730 ms >" in Feasibility(12.345, 50, 50, 8, 1).explain()


@given(st.floats(1e-4, 1), st.sampled_from([1, 2, 5]), st.integers(2, 32), st.integers(0, 3), st.integers(0, 40))
def test_the_fastest_feasible_rate_is_feasible_and_no_faster_one_is(
    latency: float, ticks: int, horizon: int, margin: int, reserve: int
) -> None:
    def at(hz: float) -> Feasibility:
        return Feasibility(latency, hz * ticks, hz, horizon, margin, reserve)

    hz = at(10.0).max_policy_hz
    if hz > 0:
        assert at(hz * 0.999).feasible
        assert not at(hz * 1.001).feasible


@given(st.floats(1e-4, 1), st.integers(2, 32), st.integers(0, 3), st.integers(0, 40))
def test_the_longest_feasible_call_is_feasible_and_no_longer_one_is(
    latency: float, horizon: int, margin: int, reserve: int
) -> None:
    longest = Feasibility(latency, 10.0, 10.0, horizon, margin, reserve).max_latency
    if longest > 0:
        assert Feasibility(longest * 0.999, 10.0, 10.0, horizon, margin, reserve).feasible
        assert not Feasibility(longest * 1.001 + 1e-9, 10.0, 10.0, horizon, margin, reserve).feasible


def test_the_longest_of_the_last_calls_counts() -> None:
    window = LatencyWindow(3)
    assert window.bound == 0
    bounds = []
    for latency in (1, 5, 2, 3, 1):
        window.add(latency)
        bounds.append(window.bound)
    assert bounds == [1, 5, 5, 5, 3]


def test_tiers_go_down_when_deadlines_are_missed_and_back_up() -> None:
    tiers = Tiers(["slow", "middle", "fast"], down_after=2, up_after=3)
    assert [tiers.after_call(missed) for missed in (True, False, True, True)] == [0, 0, 0, 1]
    assert tiers.plan == "middle"
    assert [tiers.after_call(True) for _ in range(4)] == [0, 1, 0, 0]
    assert tiers.plan == "fast"
    assert [tiers.after_call(False) for _ in range(6)] == [0, 0, -1, 0, 0, -1]
    assert tiers.plan == "slow"
    assert tiers.after_call(False) == 0


def test_a_tier_that_fails_again_and_again_is_tried_less_and_less() -> None:
    tiers = Tiers(["slow", "fast"], down_after=1, up_after=2)
    waits, since = [], 0
    for _ in range(4000):
        missed = tiers.plan == "slow"
        since += 1
        if tiers.after_call(missed) == -1:
            waits.append(since)
            since = 0
    assert waits[:5] == [3, 5, 9, 17, 33]
    assert max(waits) == 2 * MOST_PATIENCE + 1
    for _ in range(200):  # the load has gone
        tiers.after_call(False)
    assert tiers.plan == "slow"
    assert [tiers.after_call(m) for m in (True, False, False)] == [1, 0, -1]  # and the failures are forgotten


def test_one_plan_has_nowhere_to_go() -> None:
    tiers = Tiers(["only"], 1, 1)
    assert [tiers.after_call(m) for m in (True, True, False, False)] == [0, 0, 0, 0]
    assert tiers.plan == "only"


def test_the_guard_takes_its_bounds_from_the_normaliser() -> None:
    guard = Guard(GuardLimits(margin=0.1), NORMALIZER, 2)
    assert guard.refuse(rows((-2.4, -2), (2.4, 22))) is None
    assert guard.refuse(rows((0, 0), (2.41, 0))) == "action 1, channel 0, is 2.41; the bounds are -2.4 to 2.4"
    assert "channel 1, is -2.1" in str(guard.refuse(rows((0, -2.1))))
    assert Guard(GuardLimits(), None, 2).refuse(rows((1e30, -1e30))) is None
    assert Guard(GuardLimits(low=0.0), NORMALIZER, 2).refuse(rows((-0.1, 5))) is not None


def test_a_normaliser_with_a_row_for_each_step_bounds_by_all_of_them() -> None:
    """In the first row the numbers are in -2..2 and 0..20, in the last one in -4..4 and 10..30."""
    steps = Affine(np.array([[0.5, -0.1], [0.25, -0.1]]), np.array([[0.0, 1.0], [0.0, 2.0]]))
    guard = Guard(GuardLimits(margin=0.0), steps, 2)
    assert guard.refuse(rows((-4, 0), (4, 30), (0, 15))) is None
    assert "channel 0, is 4.1; the bounds are -4 to 4" in str(guard.refuse(rows((4.1, 5))))
    assert "channel 1, is -0.1; the bounds are -0 to 30" in str(guard.refuse(rows((0, -0.1))))
    usual = ChunkSpec(2, 0, 2, steps, switches=(Switch(1, 0.5, 3.0, 5.0),)).usual
    assert usual is not None
    assert "the bounds are 3 to 5" in str(Guard(GuardLimits(margin=0.0), usual, 2).refuse(rows((0, 6))))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_the_guard_refuses_what_is_no_number_with_and_without_bounds(bad: float) -> None:
    for normalizer in (None, NORMALIZER):
        assert Guard(GuardLimits(), normalizer, 2).refuse(rows((0, 5), (bad, 5))) == "1 of its 4 numbers are not finite"


def test_the_guard_limits_steps_the_seam_included() -> None:
    guard = Guard(GuardLimits(max_step=[1.0, 5.0]), None, 2)
    nothing = np.empty((0, 2), np.float32)
    assert guard.refuse_motion(nothing, rows((9, 9))) is None
    assert guard.refuse_motion(rows((0, 0)), rows((1, 5), (0, 0))) is None
    assert guard.refuse_motion(rows((0, 0)), rows((1.5, 0))) == "its step of 1.5 in channel 0 exceeds the limit of 1"
    assert "channel 1" in str(guard.refuse_motion(nothing, rows((0, 0), (0, 6))))
    assert guard.refuse_motion(rows((9, 9), (0, 0)), rows((0, 0))) is None  # what was played cannot be undone


def test_the_guard_limits_jerk() -> None:
    guard = Guard(GuardLimits(max_jerk=1.0), None, 1)
    even = np.arange(6, dtype=np.float32)[:, None] ** 2  # constant acceleration
    assert guard.refuse_motion(even[:3], even[3:]) is None
    assert "its jerk of 8 in channel 0" in str(guard.refuse_motion(even[:3], np.array([[17.0]], np.float32)))
    assert guard.refuse_motion(even[:1], even[1:3]) is None  # too few to have one


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"margin": -1}, "margin must not be negative"),
        ({"max_step": 0}, "max_step must be positive"),
        ({"max_jerk": [1, -1]}, "max_jerk must be positive"),
        ({"low": [1, 2, 3]}, "one for each of 2 channels"),
        ({"low": 3.0, "high": 2.0}, "leave no room"),
        ({"low": float("nan")}, "must be a number"),
    ],
)
def test_limits_are_checked(limits: dict[str, object], message: str) -> None:
    with pytest.raises(ExecutorError, match=message):
        Guard(GuardLimits(**limits), NORMALIZER, 2)  # type: ignore[arg-type]
