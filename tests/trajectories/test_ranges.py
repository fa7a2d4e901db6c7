"""Recordings that are not what the policy observes: reversed, in another unit, random; a few outliers pass."""

from __future__ import annotations

import re
import warnings

import numpy as np
import numpy.typing as npt
import pytest

from ttscompile import Affine, ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.core.finding import Level
from ttscompile.errors import TrajectoryError
from ttscompile.trajectories import Episode
from ttscompile.trajectories.fits import check_ranges, judged, placed

from ..calibration import policies

RANGES: npt.NDArray[np.float32] = np.array([[0, 512], [0, 512], [-3, 3], [0.2, 0.4]], np.float32)
"""Of four numbers in the training data: two of a position, an angle and a width."""


def policy(ranged: bool = True) -> PolicySpec:
    like, width = policies.spec(), RANGES[:, 1] - RANGES[:, 0]
    normalizer = Affine((2 / width).astype(np.float32), -(RANGES[:, 1] + RANGES[:, 0]) / width)
    chunk = ChunkSpec(2, 1, 5, None, ranged=ranged)
    return PolicySpec((8, 2), {"obs": ObservationSpec((2, 4), normalizer)}, like.sampler, chunk)


def true_recording() -> np.ndarray:
    """50 calls, uniform in the ranges."""
    return np.random.default_rng(0).uniform(RANGES[:, 0], RANGES[:, 1], (50, 2, 4)).astype(np.float32)


def check(values: np.ndarray, ranged: bool = True) -> None:
    halves = np.split(values.astype(np.float32), 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_ranges([Episode(f"calls[{n}]", {"obs": half}) for n, half in enumerate(halves)], policy(ranged))


def test_a_true_recording_with_a_few_outliers_passes() -> None:
    values = true_recording()
    check(values)
    values[3, 0, :2] = 900, -300  # two of 400 numbers
    check(values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.concatenate([true_recording()[:46], 2 * true_recording()[46:]]), "of 400 recorded numbers"),
        (true_recording() + np.array([0, 0, 0, 1]), r"'obs': 100 of 400 recorded numbers \(25%\) .*columns 3 \(100%\)"),
    ],
)
def test_some_outside_are_a_warning_with_counts(values: np.ndarray, message: str) -> None:
    with pytest.raises(UserWarning, match=message):
        check(values)
    check(values, ranged=False)  # as many are outside of one deviation of what is normalised by that


def test_permuted_columns_are_refused_and_named() -> None:
    like = policies.spec()
    normalizer = Affine(np.array([2, 2], np.float32), np.array([-1, -21], np.float32))  # 0..1 and 10..11
    spec = PolicySpec((8, 2), {"obs": ObservationSpec((1, 2), normalizer)}, like.sampler, ChunkSpec(2, 0, 4))
    values = np.random.default_rng(0).uniform([10, 0], [11, 1], (20, 1, 2)).astype(np.float32)
    with pytest.raises(TrajectoryError, match=r"column 0 is as 1 was, column 1 is as 0 was.*look permuted"):
        check_ranges([Episode("calls[0]", {"obs": values})], spec)
    check_ranges([Episode("calls[0]", {"obs": values[..., ::-1]})], spec)


@pytest.mark.parametrize(
    "values", [100 * true_recording(), np.random.default_rng(1).uniform(-1e3, 1e3, (50, 2, 4)), true_recording() - 1000]
)
@pytest.mark.parametrize("ranged", [True, False])
def test_most_outside_are_refused(values: np.ndarray, ranged: bool) -> None:
    with pytest.raises(TrajectoryError, match=r"'obs': \d+ of 400 recorded numbers .*unit.*order.*means nothing"):
        check(values, ranged)


def test_what_is_said_is_true_of_means_and_deviations_too() -> None:
    """Of numbers of deviation 1 a third lie beyond -1..1, and they fill several times as much."""
    spec = PolicySpec(
        (8, 2),
        {"obs": ObservationSpec((1, 7), Affine(np.ones(7, np.float32), np.zeros(7, np.float32)))},
        policies.spec().sampler,
        ChunkSpec(2, 0, 4, ranged=False),
    )
    values = np.random.default_rng(0).normal(size=(200, 1, 7)).astype(np.float32)
    (fine,), (wrong,) = (
        [judged(one) for one in placed([Episode("calls[0]", {"obs": each})], spec)] for each in (values, values + 9)
    )
    expected = (
        r"29\.\d% of the numbers lie outside of what .* maps to -1..1; half of the columns fill 2\d\d% of that, or more"
    )
    assert fine.level is Level.OK and re.fullmatch(expected, fine.found)
    assert wrong.level is Level.PROBLEM
    assert re.search(r"times; columns (\d \(100%\), ){4}\d \(100%\) and 2 more\. Look at their unit", wrong.told)


def test_whole_numbers_and_what_is_not_normalised_say_nothing() -> None:
    like = policies.spec()
    specs = {"obs": ObservationSpec((2, 4)), "task": ObservationSpec((3,), dtype="int64", window=False, bounds=(0, 9))}
    spec = PolicySpec((8, 2), specs, like.sampler, ChunkSpec(2, 1, 5))
    check_ranges([Episode("calls[0]", {"obs": 1e4 * true_recording(), "task": np.full((50, 3), 9)})], spec)
