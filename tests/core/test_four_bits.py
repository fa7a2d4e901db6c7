"""Matrices in four bits, by hand and on random ones."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ttscompile.core.four_bits import BLOCK, further_off, pack, unpack


def test_two_numbers_are_one_byte_and_the_first_is_its_low_half() -> None:
    """One column: -8, 7, 1 and zeros, in steps of 0.5; the second block is its one row, which is its own step."""
    matrix = np.zeros((BLOCK + 1, 1), np.float32)
    matrix[:3, 0], matrix[BLOCK, 0] = (-4.0, 3.5, 0.5), 6.0
    packed, scales = pack(matrix)
    assert packed.shape == (1, 2, BLOCK // 2) and packed.dtype == np.uint8
    assert packed[0, 0, :3].tolist() == [0 | 15 << 4, 9 | 8 << 4, 8 | 8 << 4]
    assert packed[0, 1, 1:].tolist() == [8 | 8 << 4] * (BLOCK // 2 - 1)
    assert scales[0, 0] == 0.5
    np.testing.assert_allclose(unpack(packed, scales, len(matrix)), matrix, atol=1e-6)


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 200), st.integers(1, 9), st.integers(0, 2**32 - 1), st.integers(-30, 30))
def test_no_block_is_further_off_than_plain_rounding(rows: int, columns: int, seed: int, exponent: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = (rng.standard_normal((rows, columns)) ** 3 * 10.0 ** rng.uniform(exponent - 3, exponent, columns)).astype(
        "f4"
    )
    matrix[:, rng.random(columns) < 0.2] = 0
    packed, scales = pack(matrix)
    assert np.isfinite(scales).all()
    assert further_off(packed, scales, matrix) <= 1.001
    found = unpack(packed, scales, rows)
    assert found.shape == matrix.shape and not found[:, ~matrix.any(axis=0)].any()


@pytest.mark.parametrize("rows", [BLOCK, 5 * BLOCK + 7])
def test_a_normal_matrix_is_nine_percent_off(rows: int) -> None:
    matrix = np.random.default_rng(0).standard_normal((rows, 300)).astype(np.float32)
    packed, scales = pack(matrix)
    off = np.linalg.norm(unpack(packed, scales, rows) - matrix) / np.linalg.norm(matrix)
    assert 0.08 < off < 0.1
    assert further_off(packed, scales * np.float32(1.2), matrix) > 1.1
    assert further_off(packed[::-1], scales[::-1], matrix) > 2
