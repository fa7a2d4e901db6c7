"""The golden record's arithmetic: the same on every machine, and small whatever the policy is."""

import numpy as np
import pytest

from ttscompile.artifact.golden import DIGITS, PATTERN, expand, pattern, pattern_size, probe_stream, project
from ttscompile.ir.graph import Batch, TensorType

STREAM = TensorType((Batch(), 30, 40), "float32")


def test_probe_streams_are_the_same_everywhere() -> None:
    """Numbers of this test were printed once: a numpy that gives others would refuse every artifact."""
    small = probe_stream(2, TensorType((Batch(), 3, 4), "float32"), 2, 0.5)
    np.testing.assert_array_equal(small[0, 0], np.array([-0.71767676, -0.45585757, 0.5218226, 0.1423088], np.float32))
    stream = probe_stream(0, STREAM, 2, 0.5)
    assert stream.std() == pytest.approx(0.5, rel=0.05)
    assert abs(stream).max() <= 0.5 * np.sqrt(3)
    assert not np.array_equal(stream, probe_stream(1, STREAM, 2, 0.5))


def test_projections_are_the_same_everywhere() -> None:
    found = project(np.arange(24, dtype=np.float32).reshape(2, 3, 4), 0)
    np.testing.assert_array_equal(found[1, :4], np.array([10.0, 6.5, -3.0, 2.0], np.float32))


def test_projections_keep_the_size_of_a_difference() -> None:
    draw = np.random.default_rng(0)
    ratios = []
    for _ in range(200):
        difference = draw.standard_normal((1, 30, 40)) * draw.uniform(0, 1, (1, 30, 40)) ** 4
        ratios.append(np.linalg.norm(project(difference, 0)) / np.linalg.norm(difference))
    assert np.mean(ratios) == pytest.approx(1, abs=0.05)
    assert min(ratios) > 0.3
    assert max(ratios) < 2


def test_projections_tell_streams_apart_wherever_their_axis_is() -> None:
    array = np.random.default_rng(0).standard_normal((5, 2, 7))
    found = project(array, 1)
    assert found.shape == (2, DIGITS)
    np.testing.assert_array_equal(found[1], project(array[:, 1][None], 0)[0])
    assert project(array, None).shape == (1, DIGITS)


@pytest.mark.parametrize("shape", [(2, 20), (2, 96, 96, 3), (3, 2, 50_000), (1,)])
def test_large_observations_repeat_a_pattern_of_whole_rows(shape: tuple[int, ...]) -> None:
    size = pattern_size(shape)
    assert size % shape[-1] == 0
    assert size <= max(PATTERN, shape[-1])
    array = np.random.default_rng(0).integers(0, 256, (2, *shape)).astype(np.uint8)
    stored = pattern(array, shape)
    assert stored.shape == (2, size)
    whole = expand(stored, shape)
    assert whole.shape == (2, *shape)
    assert whole.dtype == np.uint8
    np.testing.assert_array_equal(pattern(whole, shape), stored)
    if size == np.prod(shape):
        np.testing.assert_array_equal(whole, array)
