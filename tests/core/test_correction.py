"""The record of a correction: what it must look like, what it costs, and when action dimensions share it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.runtimes.plans import jumping
from ttscompile.core.correction import (
    COMPONENTS,
    HIDDEN,
    LARGEST,
    MOST_NUMBERS,
    Correction,
    components_of,
    condition_flops,
    correction_flops,
    groups_of,
    jump_flops,
    jumps_of,
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
    added = correction.from_condition(correction.read(condition))
    assert added.shape == (5, 2, 2, 4)
    by_hand = sum(condition[1] @ correction.reading[:, f] * correction.observed[f, 3, 1, 2] for f in range(3))
    np.testing.assert_allclose(added[3, 1, 1, 2], by_hand, rtol=1e-5)


def test_a_jump_goes_from_an_anchor_to_the_step_before_the_next() -> None:
    assert jumps_of(np.array([1, 0, 0, 1, 1, 0, 1, 0], np.bool_)) == {0: 2, 4: 5}
    assert jumping([True, False, False, True, True, False, True, False]).landings == {2: 0, 5: 1}
    assert no_correction(5, (4, 2)).landings == {}


def test_a_jump_is_two_hidden_layers_on_what_is_read_and_the_history() -> None:
    correction = jumping([True, False, False, True, False, True])
    rng = np.random.default_rng(3)
    read, history = (rng.standard_normal(shape).astype(np.float32) for shape in ((2, 3), (2, 2, 16)))
    added = correction.jump(1, read, history)
    assert added.shape == (2, 2, 4)
    value = np.concatenate([read[1], history[0, 1], history[1, 1]])
    for layer in (correction.inner[1], correction.middle[1]):
        value = np.maximum(sum(layer[i] * value[i] for i in range(len(value))) + layer[-1], 0)
    by_hand = sum(value[i] * correction.outer[1, i] for i in range(HIDDEN)) + correction.outer[1, -1]
    np.testing.assert_allclose(added[:, 1].reshape(-1), by_hand, rtol=1e-4, atol=1e-5)
    assert jump_flops((4, 2), 3) == 2 * (35 * HIDDEN + HIDDEN * HIDDEN + HIDDEN * 8)


@pytest.mark.parametrize("change", ["anchors", "inner", "middle", "outer", "dtype", "chunk", "nan"])
def test_jumps_that_fit_nothing_are_refused(change: str) -> None:
    good = jumping([True, False, True, False, False])
    if change == "chunk":
        with pytest.raises(IllegalPlanError, match="none of a chunk of more than 1024 numbers"):
            jumping([True, False, True], horizon=513)
        return
    changed: dict[str, Any] = {
        "anchors": {"anchors": np.array([True, False, True, False, True])},
        "inner": {"inner": good.inner[:, 1:]},
        "middle": {"middle": good.middle[:, :, :-1]},
        "outer": {"outer": np.zeros((0, 0, 0), np.float32)},
        "dtype": {"outer": good.outer.astype(np.float64)},
        "nan": {"outer": good.outer * np.float32(np.nan)},
    }[change]
    with pytest.raises(IllegalPlanError, match="not finite" if change == "nan" else "jumps"):
        replace(good, **changed)


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
    inputs = jumping([True, False, True, False, False]).inputs()
    assert inputs["correction_jumps"].tolist() == [-1, 0, -1, -1, -1]
    assert inputs["correction_inner"].shape == (1, 7 + 33, HIDDEN)


def test_a_call_with_a_prefix_has_the_one_that_was_fitted_on_such_calls() -> None:
    own, late = no_correction(5, (4, 2)), replace(no_correction(5, (4, 2)), prefixes=3)
    both = replace(own, late=late)
    assert both.of(0) is both and both.of(1) is late and both.of(4) is late
    assert own.of(2) is own and (own.prefixes, both.of(2).prefixes) == (0, 3)
    with pytest.raises(IllegalPlanError, match="this policy needs"):
        replace(own, late=no_correction(6, (4, 2))).require_fit(5, (4, 2), 7)


@pytest.mark.parametrize("prefixes", [-1, 5, 1.5, True])
def test_prefixes_are_a_number_of_actions_of_the_chunk(prefixes: Any) -> None:
    with pytest.raises(IllegalPlanError, match=r"prefixes of a correction must be an integer .* at most 4; found"):
        replace(no_correction(5, (4, 2)), prefixes=prefixes)
