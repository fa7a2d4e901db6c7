"""What vla.cpp is given, and what is told of the times."""

import ctypes

import numpy as np
import pytest
import vla_cpp


@pytest.mark.parametrize(("height", "width"), [(480, 640), (512, 512), (640, 480)])
def test_they_are_square_and_start_with_padding(height: int, width: int) -> None:
    made = vla_cpp.squared(np.ones((1, 3, height, width), np.float32))
    assert made.shape == (512, 512, 3)
    rows, columns = (np.flatnonzero(made[:, :, 0].any(axis=axis)) for axis in (1, 0))
    assert (rows[-1], columns[-1]) == (511, 511)
    assert len(rows) * width == pytest.approx(len(columns) * height, rel=0.01)


def test_the_structures_have_the_sizes_of_the_interface() -> None:
    assert (ctypes.sizeof(vla_cpp.Image), ctypes.sizeof(vla_cpp.Inputs)) == (24, 80)


def test_medians_are_of_the_calls_that_count_and_beside_those_of_the_first() -> None:
    uncounted = [[9.0, 9.0]] * vla_cpp.UNCOUNTED
    times = {"theirs": [*uncounted, [3.0, 1.0], [4.0, 2.0], [30.0, 3.0]], "ours": [*uncounted, [1.0, 0.5]]}
    assert [line.split() for line in vla_cpp.told(times)] == [
        ["6.00", "s", "1.00", "times", "vla.cpp", "theirs:", "4.00,", "2.00"],
        ["1.50", "s", "4.00", "times", "vla.cpp", "ours:", "1.00,", "0.50"],
    ]
