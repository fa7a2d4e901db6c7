"""The one timer: what is timed, who goes first, and what counts."""

from __future__ import annotations

import numpy as np
import pytest

from ttscompile.measure.points import best_plan
from ttscompile.measure.timer import MANY, Timer, Times


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def wait(self, seconds: float) -> float:
        self.now += seconds
        return seconds


def test_candidates_take_turns_and_warm_up_does_not_count() -> None:
    clock, order = Clock(), []
    timer = Timer(3, warm_up=1, clock=clock)
    for number in range(4):
        for i in timer.round():
            order.append(i)
            clock.wait(100.0)  # what the caller prepares is not timed
            assert timer.time(i, lambda: clock.wait(number + 0.1 * i)) == number + 0.1 * i  # noqa: B023
        assert timer.counted == number
    assert order == [0, 1, 2, 1, 2, 0, 2, 0, 1, 0, 1, 2]
    assert [times.ms for times in timer.times] == [
        pytest.approx([1e3 * (n + 0.1 * i) for n in (1, 2, 3)]) for i in range(3)
    ]


def test_medians_and_quartiles_are_numpys() -> None:
    for count in (1, 2, 3, 4, 7, 50):
        ms = tuple(np.random.default_rng(count).exponential(size=count).tolist())
        times = Times(ms)
        assert times.median == pytest.approx(np.median(ms))
        assert times.quartiles == pytest.approx(np.percentile(ms, [25, 75]))


def test_the_longest_of_a_hundred_calls_is_their_99th_percentile() -> None:
    draw = np.random.default_rng(0).exponential(size=200)
    assert Times(tuple(draw.tolist())).worst == pytest.approx(np.percentile(draw, 99))
    assert Times(tuple(draw[:MANY].tolist())).worst == pytest.approx(np.percentile(draw[:MANY], 99))
    assert Times((1.0,) * 98 + (7.0,)).worst == 7.0


def test_of_plans_whose_distances_are_printed_alike_the_faster_is_the_nearest() -> None:
    """That in eight bits, say, of which the other is the same in fp32; a plan that is really nearer is taken."""
    times = {"fp32": Times((68.5,)), "int8": Times((41.4,)), "near": Times((90.0,))}
    distances = {"fp32": 0.11156, "int8": 0.11162, "near": 0.104}
    alike = {name: times[name] for name in ("fp32", "int8")}
    assert best_plan(alike, distances, 100.0) == "int8"
    assert best_plan(times, distances, 100.0) == "near"


def test_without_a_deadline_it_is_the_fastest_and_of_none_there_is_none() -> None:
    times = {"slow": Times((9.0,)), "fast": Times((1.0,))}
    assert best_plan(times, {"slow": 0.0, "fast": 0.1}, None) == "fast"
    assert best_plan({}, {}, None) is None and best_plan({}, {}, 1.0) is None
    assert best_plan(times, {"slow": 0.0, "fast": 0.1}, 0.5) is None
