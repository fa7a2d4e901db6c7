"""Matrices in four bits: each ``BLOCK`` rows of a column have a scale of their own.

``docs/decisions.md`` has what that costs in time and in error, beside eight bits.
"""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]

BLOCK_PRODUCT = "MatMulNBits"
"""Reads float32, quantises each block of a row to int8, and sums products of integers block by block."""

BLOCK = 64
"""Rows of a scale. With 32 a normal matrix is 8.1 % off, with 64 9.0 %; it takes 5 and 4.5 bits a number."""

ATTRIBUTES = {"bits": 4, "block_size": BLOCK, "accuracy_level": 4}
"""Accuracy level 4: sums of eight-bit integers."""

_ZERO, _MOST = 8, 15
_SHARES = np.array([0.8, 0.87, 0.94, 1, -0.83, -0.9, -0.97, -1.04], np.float32)
"""Of the scale that rounds the largest number of a block to the end of the range: those that are tried."""

_LEAST = 1e-12
"""Squared error of a block, in units of its largest number, that is rounding of float32."""

_PART = 2**18
"""Numbers that are rounded at once: what that takes stays in the processor's cache, where it is 1.8 times faster."""


def pack(matrix: Array) -> tuple[npt.NDArray[np.uint8], Array]:
    """A matrix ``[rows, columns]`` as ``MatMulNBits`` reads it.

    Of several scales a block takes the one with the least squared error, each the best for its integers.

    Returns:
        uint8 ``[columns, blocks, BLOCK / 2]``, two numbers a byte, the first of them in the low half, each 8 more than
        it stands for; and the scales, float32 ``[columns, blocks]``. Rows that fill the last block are zeros.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # large operations of numpy's, which let others run
        parts = pool.map(lambda columns: _pack(_blocks(matrix[:, columns])), columns_at_once(matrix))
        packed, scales = (np.concatenate(each) for each in zip(*parts, strict=True))
    return packed, scales


def columns_at_once(matrix: Array) -> Iterator[slice]:
    """Columns that are rounded together: a matrix may be a tenth of the memory, and rounding takes several times it."""
    count = max(1, _PART // max(1, len(matrix)))
    return (slice(i, i + count) for i in range(0, matrix.shape[1], count))


def unpack(packed: npt.NDArray[np.uint8], scales: Array, rows: int) -> Array:
    """What a packed matrix stands for, ``[rows, columns]``."""
    integers = np.stack([packed & 15, packed >> 4], axis=-1).reshape(*packed.shape[:2], -1)
    values = (integers.astype(np.float32) - _ZERO) * scales[:, :, None]
    return np.ascontiguousarray(values.reshape(len(packed), -1)[:, :rows].T)


def further_off(packed: npt.NDArray[np.uint8], scales: Array, matrix: Array) -> float:
    """How far a packed matrix is from this one: of its worst block, as a share of what plain rounding is off."""
    blocks, largest = _of_largest(_blocks(matrix))
    made = _blocks(unpack(packed, scales, len(matrix))) / largest[:, :, None]
    plain = _rounded(blocks, _plain(blocks))[1] + np.float32(_LEAST)
    return float(np.sqrt((np.square(made - blocks).sum(axis=2) / plain).max()))


def _blocks(matrix: Array) -> Array:
    """``[columns, blocks, BLOCK]``."""
    filled = np.pad(matrix, ((0, -len(matrix) % BLOCK), (0, 0)))
    return np.ascontiguousarray(filled.T).reshape(matrix.shape[1], -1, BLOCK)


def _of_largest(blocks: Array) -> tuple[Array, Array]:
    """Blocks as shares of their largest numbers, whose squares neither overflow nor vanish; and these numbers."""
    largest = np.abs(blocks).max(axis=2)
    largest = np.asarray(np.where(largest < 1 / np.finfo(np.float32).max, 1, largest), np.float32)
    return np.asarray(blocks / largest[:, :, None], np.float32), largest


def _plain(blocks: Array) -> Array:
    """The scales by which the largest number of each block, whatever its sign, is -8."""
    largest = np.take_along_axis(blocks, np.abs(blocks).argmax(axis=2)[:, :, None], axis=2)[:, :, 0]
    return np.asarray(largest / -_ZERO, np.float32)


def _rounded(blocks: Array, scales: Array) -> tuple[Array, Array]:
    """Integers -8..7 by these scales, and the squared error of each block."""
    used = np.where(np.abs(scales) < np.finfo(np.float32).tiny, np.float32(1), scales)[:, :, None]
    integers = np.clip(np.rint(blocks / used), -_ZERO, _MOST - _ZERO)
    return integers, np.square(integers * used - blocks).sum(axis=2)


def _pack(blocks: Array) -> tuple[npt.NDArray[np.uint8], Array]:
    blocks, largest = _of_largest(blocks)
    best = _plain(blocks)
    integers, error = _rounded(blocks, best)
    for share in _SHARES:
        tried, _ = _rounded(blocks, share * _plain(blocks))
        # Of fixed integers the best scale is the projection, and the error what it leaves.
        product, norm = np.einsum("cbi,cbi->cb", tried, blocks), np.einsum("cbi,cbi->cb", tried, tried)
        scale = product / np.maximum(norm, 1)
        off = np.square(tried * scale[:, :, None] - blocks).sum(axis=2)
        better = off < error
        best, error = np.where(better, scale, best), np.where(better, off, error)
        np.copyto(integers, tried, where=better[:, :, None])
    codes: npt.NDArray[np.uint8] = (integers + _ZERO).astype(np.uint8)
    return codes[..., 0::2] | (codes[..., 1::2] << np.uint8(4)), (best * largest).astype(np.float32)
