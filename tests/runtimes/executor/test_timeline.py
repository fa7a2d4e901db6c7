"""Actions by tick, and how chunks join."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ttscompile.runtimes.executor.timeline import TickGrid, Timeline, expand, splice


def line(start: int, *values: float, observed: float = 0.0) -> Timeline:
    return Timeline.of(start, np.array(values, np.float32)[:, None], observed)


def played(made: Timeline | None) -> tuple[int, list[float]]:
    assert made is not None
    return made.start, made.rows[:, 0].tolist()


def test_a_tick_is_the_nearest() -> None:
    grid = TickGrid(10)
    assert grid.tick(5.0) == 0
    assert [grid.tick(t) for t in (4.96, 5.04, 5.06, 5.96, 4.8)] == [0, 0, 1, 10, -2]
    assert grid.time(10) == pytest.approx(6.0)


def give(grid: TickGrid, time: float) -> int:
    tick = grid.tick(time)
    grid.follow(time, tick)
    return tick


def test_the_first_action_moves_the_grid_so_that_jitter_skips_no_tick() -> None:
    grid = TickGrid(10)
    grid.tick(0.0)
    ticks = [give(grid, 0.149 + 0.1 * i + jitter) for i, jitter in enumerate((0, 0.02, -0.02, 0.04, -0.04))]
    assert ticks == [1, 2, 3, 4, 5]
    assert TickGrid(10).tick(7.0) == 0  # of the next episode, which has a grid of its own


@pytest.mark.parametrize("rate", [49.7, 50.0, 50.3])
def test_a_loop_that_is_not_quite_at_its_rate_skips_no_tick(rate: float) -> None:
    grid, rng = TickGrid(50), np.random.default_rng(0)
    grid.tick(0.0)
    times = np.arange(5000) / rate + 0.2 / rate * rng.uniform(-1, 1, 5000)
    assert np.unique(np.diff([give(grid, time) for time in times])).tolist() == [1]


def test_a_loop_at_another_rate_stays_with_the_time() -> None:
    grid = TickGrid(50)
    grid.tick(0.0)
    ticks = [give(grid, i / 40) for i in range(401)]
    assert ticks[-1] == pytest.approx(500, abs=25)
    assert set(np.diff(ticks)) == {1, 2}


def test_expand() -> None:
    actions = np.array([[0.0], [1.0], [3.0]], np.float32)
    assert expand(actions, 1, "linear") is actions
    assert expand(actions, 2, "hold")[:, 0].tolist() == [0, 0, 1, 1, 3, 3]
    assert expand(actions, 2, "linear")[:, 0].tolist() == [0, 0.5, 1, 2, 3, 3]
    assert expand(actions, 4, "linear").dtype == np.float32


def test_what_was_consumed_is_not_played_again() -> None:
    assert played(splice(line(8, 1, 1, 1, 1, 1), line(10, 2, 3, 4, 5, 6), seam=13)) == (13, [5, 6])


def test_an_overdue_chunk_is_nothing() -> None:
    assert splice(line(8, 1, 1), line(10, 2, 3), seam=12) is None
    assert splice(None, line(10, 2, 3), seam=15) is None


def test_the_first_chunk() -> None:
    assert played(splice(None, line(10, 2, 3), seam=10)) == (10, [2, 3])
    assert played(splice(None, line(10, 2, 3), seam=11)) == (11, [3])


def test_what_comes_before_the_chunk_stays() -> None:
    assert played(splice(line(8, 1, 1, 1, 1), line(11, 2, 2), seam=9)) == (9, [1, 1, 2, 2])
    assert played(splice(line(8, 1, 1), line(11, 2, 2), seam=9)) == (11, [2, 2])  # nothing is made up for a gap


def test_blending_is_linear_over_its_window() -> None:
    old, new = line(0, *[0.0] * 8), line(2, *[10.0] * 8)
    start, rows = played(splice(old, new, seam=3, blend=4))
    assert start == 3
    np.testing.assert_allclose(rows, [2, 4, 6, 8, 10, 10, 10], rtol=1e-6)
    _, rows = played(splice(line(0, *[0.0] * 5), new, seam=3, blend=4))  # the old chunk ends within the window
    np.testing.assert_allclose(rows[:3], [2, 4, 10], rtol=1e-6)
    np.testing.assert_array_equal(old.rows, 0)
    np.testing.assert_array_equal(new.rows, 10)


def test_the_time_of_observation_goes_with_the_rows() -> None:
    made = splice(line(8, 1, 1, 1, 1, observed=0.8), line(11, 2, 2, observed=1.1), seam=9)
    assert made is not None
    assert made.observed.tolist() == [0.8, 0.8, 1.1, 1.1]


@given(
    st.integers(0, 6), st.integers(1, 9), st.integers(0, 9), st.integers(1, 9), st.integers(0, 12), st.integers(0, 5)
)
def test_a_schedule_has_no_hole_and_starts_at_or_after_the_seam(
    old_start: int, old_length: int, new_start: int, new_length: int, seam: int, blend: int
) -> None:
    old, new = line(old_start, *[1.0] * old_length), line(new_start, *[2.0] * new_length)
    made = splice(old, new, seam, blend)
    assert (made is None) == (new.end <= seam)
    if made is None:
        return
    assert seam <= made.start <= max(seam, new_start)
    assert made.end == new.end
    assert len(made.rows) == len(made.observed)
    for tick in range(made.start, made.end):
        (value,) = np.asarray(made.at(tick))
        both = old.at(tick) is not None and tick >= new_start
        first = max(seam, new_start)
        if tick < new_start:
            assert value == 1
        elif both and first >= old.start and tick < first + blend:
            assert value == pytest.approx(1 + (tick - first + 1) / (blend + 1))
        else:
            assert value == 2
    assert made.at(made.start - 1) is None
    assert made.at(made.end) is None
