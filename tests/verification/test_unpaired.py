"""How a plan is judged whose calls answer the same noise with other actions."""

from __future__ import annotations

import numpy as np
import pytest

from ttscompile.core.sampler import SamplerTable
from ttscompile.samplers.flow import flow_matching_table
from ttscompile.verification.reuse import NEGLIGIBLE, Unpaired, _promised, allowed


@pytest.mark.parametrize(("moved", "least", "most"), [(0.0, 0.0, 0.25), (0.5, 0.2, 0.6), (3.0, 1.2, 3.0)])
def test_what_answers_are_tells_them_apart_and_not_their_noise(moved: float, least: float, most: float) -> None:
    draw, found = np.random.default_rng(0), Unpaired("fast")
    for _ in range(300):
        own, dense = draw.standard_normal((2, 2, 8, 3))
        found.add(own + moved, dense)
    assert least <= abs(found.distance) <= most


def test_the_same_answers_are_at_no_distance() -> None:
    found, answers = Unpaired("fast"), np.random.default_rng(0).standard_normal((2, 8, 3))
    found.add(answers, answers)
    assert found.distance == 0


def test_calls_at_rest_keep_the_unit_of_the_others() -> None:
    """Of three in ten calls both draws give the same: the unit is what noise changes on average over all calls."""
    draw, found, calls = np.random.default_rng(0), Unpaired("fast"), []
    for number in range(100):
        own = dense = np.full((2, 8, 3), draw.standard_normal())
        if number % 10 >= 3:
            own, dense = draw.normal(0, 0.05, (2, 2, 8, 3)) + dense
        else:
            own = dense + 0.2
        found.add(own, dense)
        calls.append((own.reshape(2, -1), dense.reshape(2, -1)))

    def far(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.sqrt(np.square(a - b).mean()))

    gaps = [far(x[0], y[1]) + far(x[1], y[0]) - far(x[0], x[1]) - far(y[0], y[1]) for x, y in calls]
    apart = [far(y[0], y[1]) for _, y in calls]
    assert found.distance == pytest.approx((np.mean(gaps) / np.mean(apart)) ** 0.5) and found.distance > 1


def test_which_samplers_take_noise_alike() -> None:
    """Same name, same steps, draws in both or in neither."""
    euler = flow_matching_table(4)
    assert euler.takes_noise_as(flow_matching_table(4))
    assert not euler.takes_noise_as(flow_matching_table(5))
    columns = {name: getattr(euler, name).copy() for name in SamplerTable.COLUMNS}
    columns["noise_to_next"][0] = 1
    drawing = SamplerTable(euler.name, euler.timesteps, clip=None, **columns)
    assert not euler.takes_noise_as(drawing) and drawing.takes_noise_as(drawing)


def test_an_estimate_that_lies_below_0_promises_no_more_than_its_interval() -> None:
    """Of few calls an estimate may be negative; three times that is nothing that another one could keep to."""
    record = {"plans": {"fast": {"distance": -0.144, "interval": [-0.26, 0.214]}, "old": {"distance": 0.1}}}
    promised = _promised(record, "fast", "distance", "interval")
    assert promised == 0.214
    assert allowed(promised, NEGLIGIBLE, 28)[1] == pytest.approx(3 * 0.214)
    assert _promised(record, "old", "distance", "interval") == 0.1, "of a plan without an interval"
    assert _promised(record, "none", "distance", "interval") is None
