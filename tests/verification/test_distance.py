"""How far a plan is from the original, as ``verify`` measures it: by the judge's distance, and without torch."""

from __future__ import annotations

import numpy as np
import pytest

from ttscompile.core.sampler import SamplerTable
from ttscompile.measure.points import Gaps
from ttscompile.samplers.flow import flow_matching_table
from ttscompile.verification.reuse import NEGLIGIBLE, bounds


def distance(own: np.ndarray, original: np.ndarray) -> float:
    """Of the calls of one episode."""
    return Gaps.of(own, original, np.zeros(len(own), np.int64)).distance


@pytest.mark.parametrize(("moved", "least", "most"), [(0.0, 0.0, 0.25), (0.5, 0.2, 0.6), (3.0, 1.2, 3.0)])
def test_what_answers_are_tells_them_apart_and_not_their_noise(moved: float, least: float, most: float) -> None:
    own, original = np.random.default_rng(0).standard_normal((2, 300, 2, 24))
    assert least <= abs(distance(own + moved, original)) <= most


def test_the_same_answers_are_at_no_distance() -> None:
    answers = np.random.default_rng(0).standard_normal((1, 2, 24))
    assert distance(answers, answers) == 0


def test_calls_at_rest_keep_the_unit_of_the_others() -> None:
    """Of three in ten calls both draws give the same: the unit is what noise changes on average over all calls."""
    draw, calls = np.random.default_rng(0), []
    for number in range(100):
        own = dense = np.full((2, 24), draw.standard_normal())
        if number % 10 >= 3:
            own, dense = draw.normal(0, 0.05, (2, 2, 24)) + dense
        else:
            own = dense + 0.2
        calls.append((own, dense))

    def far(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.sqrt(np.square(a - b).mean()))

    gaps = [far(x[0], y[1]) + far(x[1], y[0]) - far(x[0], x[1]) - far(y[0], y[1]) for x, y in calls]
    apart = [far(y[0], y[1]) for _, y in calls]
    found = distance(*map(np.stack, zip(*calls, strict=True)))
    assert found == pytest.approx((np.mean(gaps) / np.mean(apart)) ** 0.5) and found > 1


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
    """Of few calls an estimate may be negative; twice that is nothing that another one could keep to."""
    beyond, worse = bounds({"distance": -0.144, "interval": [-0.26, 0.214]}).values()
    assert beyond == 1.0 and worse == pytest.approx(2 * 0.214)
    assert [*bounds({"distance": 0.1}).values()] == [1.0, pytest.approx(0.2)], "of a plan without an interval"
    assert [*bounds({})] == ["more than other noise would change"]
    assert [*bounds({"distance": 1e-9}).values()] == [1.0, NEGLIGIBLE], "no distance is measured as exactly"


def test_what_is_far_by_its_calibration_may_be_as_far_as_it_was() -> None:
    beyond, worse = bounds({"distance": 0.8, "interval": [0.7, 0.9]}).values()
    assert (beyond, worse) == pytest.approx((1.6, 1.8))
