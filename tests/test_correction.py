"""The record of a correction: what it must look like, what it costs, and when action dimensions share it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ttscompile.core.correction import LARGEST, Correction, correction_flops, groups_of, no_correction
from ttscompile.errors import IllegalPlanError


def test_no_correction_has_the_shapes_of_the_policy() -> None:
    nothing = no_correction(5, (4, 2))
    assert nothing.weights.shape == (5, 2, 24, 4)
    assert nothing.bias.shape == (5, 2, 1, 4)
    assert not nothing.anchors.any()
    nothing.require_fit(5, (4, 2))


@pytest.mark.parametrize(("steps", "sample"), [(6, (4, 2)), (5, (3, 2)), (5, (4, 3))])
def test_it_fits_one_policy_only(steps: int, sample: tuple[int, int]) -> None:
    with pytest.raises(IllegalPlanError, match="this policy needs"):
        no_correction(5, (4, 2)).require_fit(steps, sample)


def test_large_policies_share_it_among_action_dimensions() -> None:
    assert groups_of(100, (16, 2)) == 2
    assert groups_of(100, (64, 14)) == 1
    assert LARGEST < 100 * 14 * 6 * 64 * 64
    assert no_correction(100, (64, 14)).weights.shape == (100, 1, 384, 64)


def test_flops_are_those_of_the_product() -> None:
    assert correction_flops((16, 2)) == 2 * 96 * 16 * 2


def test_what_does_not_fit_together_is_refused() -> None:
    good = no_correction(5, (4, 2))
    for change in (
        {"anchors": np.zeros(4, np.bool_)},
        {"anchors": np.zeros(5, np.int8)},
        {"bias": good.bias[:, :1]},
        {"weights": good.weights.astype(np.float64)},
        {"weights": good.weights[:, :, :23]},
        {"weights": good.weights[0]},
    ):
        with pytest.raises(IllegalPlanError, match="correction"):
            replace(good, **change)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_it_holds_numbers(value: float) -> None:
    good = no_correction(2, (4, 2))
    weights = good.weights.copy()
    weights[1, 0, 3, 2] = value
    with pytest.raises(IllegalPlanError, match="not finite"):
        Correction(good.anchors, weights, good.bias)
