"""Flow-matching tables against plain integration in float64."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.rounding import assert_equal_but_for_rounding
from tests.samplers.integration import NOISE, by_table, euler, rk4, velocity
from ttscompile import SamplerTable, flow_matching_table
from ttscompile.errors import SpecError


@pytest.mark.parametrize(("start", "end"), [(0.0, 1.0), (1.0, 0.0), (0.2, 0.9)])
@pytest.mark.parametrize(("method", "integrate", "evaluations"), [("euler", euler, 1), ("rk4", rk4, 4)])
@pytest.mark.parametrize("steps", [1, 7])
def test_tables_integrate(start: float, end: float, method: Any, integrate: Any, evaluations: int, steps: int) -> None:
    """Both conventions; the network is given times in order, each as often as it is evaluated there."""
    table = flow_matching_table(steps, method, start=start, end=end)
    assert (table.name, table.steps, table.stochastic) == (method, steps * evaluations, False)
    assert table.timesteps.dtype == np.float32
    assert table.timesteps[0] == np.float32(start)
    times = np.linspace(start, end, steps + 1)
    expected = integrate(NOISE, times, velocity)
    assert_equal_but_for_rounding(by_table(table, NOISE, velocity), expected, terms=table.steps)
    if steps > 1:
        other = integrate(NOISE, times[::-1], velocity)
        assert np.abs(expected - other).max() > 0.1  # the direction matters to these numbers


@pytest.mark.parametrize("steps", [1, 5])
def test_a_bound_of_the_last_step_alone_is_a_bound_of_the_finished_sample(steps: int) -> None:
    """The table that ``docs/howto/own-denoiser.md`` makes of two; with a bound at all steps the loop is another."""
    free, bounded = (flow_matching_table(steps, start=1.0, end=0.0, clip=clip) for clip in (None, 0.5))
    last: dict[str, Any] = {
        name: np.append(getattr(free, name)[:-1], getattr(bounded, name)[-1]) for name in free.COLUMNS
    }
    table = replace(bounded, **last)
    expected = np.clip(euler(NOISE, np.linspace(1, 0, steps + 1), velocity), -0.5, 0.5)
    assert table.bound == 0.5
    assert_equal_but_for_rounding(by_table(table, NOISE, velocity), expected, terms=2 * steps)
    if steps > 1:
        assert np.abs(by_table(bounded, NOISE, velocity) - expected).max() > 0.01


def test_rk4_is_of_fourth_order() -> None:
    """Halving the steps divides the error by 16; Euler's by 2."""
    exact = rk4(NOISE, np.linspace(0, 1, 2001), velocity)
    ratios = {}
    for method in ("euler", "rk4"):
        one, half = (np.abs(by_table(flow_matching_table(n, method), NOISE, velocity) - exact).max() for n in (4, 8))
        ratios[method] = one / half
    assert 1.6 < ratios["euler"] < 2.6
    assert 11 < ratios["rk4"] < 22


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_times_of_ones_own_and_scaled_timesteps(method: Any) -> None:
    times = [1.0, 0.7, 0.3, 0.25, 0.0]
    table = flow_matching_table(times, method, timestep_scale=1000.0)
    assert table.timesteps[:: table.steps // 4].tolist() == [1000, 700, 300, 250]
    found = by_table(table, NOISE, lambda x, t: velocity(x, t / 1000))
    expected = {"euler": euler, "rk4": rk4}[method](NOISE, np.array(times), velocity)
    assert_equal_but_for_rounding(found, expected, terms=table.steps)


def test_the_clipped_sample_is_where_the_velocity_leads() -> None:
    """One step from 1 to 0: the sample at the end is ``clip(x - v)``; two steps go half of the way to it at first."""
    (x, v) = np.array([0.5, 3.0]), np.array([0.3, -2.0])
    assert by_table(flow_matching_table(1, start=1.0, end=0.0, clip=1.0), x, lambda x, t: v).tolist() == [
        pytest.approx(0.2),
        1.0,
    ]
    first = x + (np.clip(x - v, -1, 1) - x) / 2
    second = np.clip(first - v / 2, -1, 1)
    found = by_table(flow_matching_table(2, start=1.0, end=0.0, clip=1.0), x, lambda x, t: v)
    assert_equal_but_for_rounding(found, second, terms=4)


@pytest.mark.parametrize("clip", [np.float32(0.5), np.array(0.5), torch.tensor(0.5)])
def test_a_bound_may_come_from_statistics(clip: Any) -> None:
    """It becomes a number of Python, which graphs and manifests take."""
    table = flow_matching_table(4, clip=clip)
    assert (type(table.clip), table.clip) == (float, 0.5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "steps must be an integer of at least 1; found 0"),
        ({"steps": True}, "steps must be an integer of at least 1; found True"),
        ({"steps": 4.0}, "integer of at least 1; found 4.0"),
        ({"steps": 4, "start": 1.0}, "all rise or all fall"),
        ({"steps": [0.0, 0.5, 0.5, 1.0]}, "all rise or all fall"),
        ({"steps": [0.0]}, "two or more"),
        ({"steps": 4, "end": float("inf")}, "all rise or all fall"),
        ({"steps": 4, "timestep_scale": float("nan")}, "timestep_scale"),
        ({"steps": 4, "method": "heun"}, "expected one of euler, rk4"),
        ({"steps": 4, "method": "rk4", "clip": 1.0}, "between the stages"),
        *(
            ({"steps": 4, "clip": each}, "clip must be a positive number")
            for each in (-1.0, 0.0, np.nan, np.inf, True, "1")
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_what_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        flow_matching_table(**arguments)


@pytest.mark.parametrize(
    ("to_next", "to_memory", "message"),
    [
        ((4, 1), (4, 1, 3), r"\[K, S, 3 \+ S\]; found \(4, 1\) and \(4, 1, 3\)"),
        ((3, 1), (4, 1, 4), r"found \(3, 1\)"),
        ((4, 1), (4, 0, 3), r"found \(4, 1\)"),
        ((4,), (4, 1, 4), r"found \(4,\)"),
    ],
)
def test_memories_of_the_wrong_shape(to_next: tuple[int, ...], to_memory: tuple[int, ...], message: str) -> None:
    columns = {name: np.zeros(4, np.float32) for name in SamplerTable.COLUMNS}
    with pytest.raises(SpecError, match=message):
        SamplerTable(
            "mine",
            np.arange(4),
            clip=None,
            **columns,
            memory_to_next=np.zeros(to_next, np.float32),
            to_memory=np.zeros(to_memory, np.float32),
        )


def test_memories_that_are_not_finite() -> None:
    columns = {name: np.zeros(1, np.float32) for name in SamplerTable.COLUMNS}
    with pytest.raises(SpecError, match="finite"):
        SamplerTable(
            "mine",
            np.array([0]),
            clip=None,
            **columns,
            memory_to_next=np.full((1, 1), np.nan, np.float32),
            to_memory=np.zeros((1, 1, 4), np.float32),
        )
