"""The record of a correction: what it must look like, what it costs, and when action dimensions share it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ttscompile.core.correction import (
    COMPONENTS,
    LARGEST,
    MOST_NUMBERS,
    Correction,
    components_of,
    condition_flops,
    correction_flops,
    groups_of,
    no_correction,
    numbers_of,
)
from ttscompile.errors import IllegalPlanError


def test_no_correction_has_the_shapes_of_the_policy() -> None:
    nothing = no_correction(5, (4, 2))
    assert nothing.weights.shape == (5, 2, 24, 4)
    assert nothing.bias.shape == (5, 2, 1, 4)
    assert nothing.reads == 0
    assert not nothing.anchors.any()
    nothing.require_fit(5, (4, 2), 7)


@pytest.mark.parametrize(("steps", "sample"), [(6, (4, 2)), (5, (3, 2)), (5, (4, 3))])
def test_it_fits_one_policy_only(steps: int, sample: tuple[int, int]) -> None:
    with pytest.raises(IllegalPlanError, match="this policy needs"):
        no_correction(5, (4, 2)).require_fit(steps, sample, 7)


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
        {"reading": np.zeros((7, 1), np.float32)},
        {"observed": good.observed[:, :4]},
        {"observed": good.observed[0:0, :, :1]},
    ):
        with pytest.raises(IllegalPlanError, match="correction"):
            replace(good, **change)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_it_holds_numbers(value: float) -> None:
    good = no_correction(2, (4, 2))
    weights = good.weights.copy()
    weights[1, 0, 3, 2] = value
    with pytest.raises(IllegalPlanError, match="not finite"):
        replace(good, weights=weights)


def reading(numbers: int, read: int, dimensions: int = 2) -> Correction:
    rng = np.random.default_rng(0)
    good = no_correction(5, (4, dimensions))
    draws = rng.standard_normal((numbers, read)), rng.standard_normal((read, 5, dimensions, 4))
    return replace(good, reading=draws[0].astype(np.float32), observed=draws[1].astype(np.float32))


def test_what_it_reads_of_the_condition_is_added_to_every_step() -> None:
    correction = reading(7, 3)
    condition = np.random.default_rng(1).standard_normal((2, 7)).astype(np.float32)
    added = correction.from_condition(condition)
    assert added.shape == (5, 2, 2, 4)
    by_hand = sum(condition[1] @ correction.reading[:, f] * correction.observed[f, 3, 1, 2] for f in range(3))
    np.testing.assert_allclose(added[3, 1, 1, 2], by_hand, rtol=1e-5)


@pytest.mark.parametrize(
    ("found", "numbers"),
    [(reading(7, 3), 8), (reading(7, 3, dimensions=2), 0), (reading(80, COMPONENTS + 1), 80), (reading(2, 3), 2)],
)
def test_it_reads_the_condition_of_one_policy_only(found: Correction, numbers: int) -> None:
    with pytest.raises(IllegalPlanError, match="of the condition"):
        found.require_fit(5, (4, 2), numbers)


def test_a_huge_condition_is_not_read_and_a_large_chunk_reads_less() -> None:
    assert numbers_of([(2, 8), (3,)]) == 19
    assert numbers_of([(MOST_NUMBERS,)]) == MOST_NUMBERS
    assert numbers_of([(MOST_NUMBERS,), (1,)]) == 0
    assert components_of(16, (12, 2), 512) == COMPONENTS
    assert components_of(16, (12, 2), 19) == 19
    assert components_of(100, (64, 14), 512) == LARGEST // (100 * 64 * 14) < COMPONENTS
    assert condition_flops(16, (12, 2), 19) == 2 * (19 * 19 + 19 * 16 * 24)
    assert condition_flops(16, (12, 2), 0) == 0


def test_a_single_file_has_an_input_for_each_of_its_arrays() -> None:
    assert set(no_correction(5, (4, 2)).inputs()) == {"correction", "correction_bias", "correction_anchors"}
    inputs = reading(7, 3).inputs()
    assert inputs["correction_reading"].shape == (7, 3)
    assert inputs["correction_observed"].shape == (3, 5, 2, 4)
