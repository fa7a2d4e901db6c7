"""Resizing images in numpy as the originals do it: with their proportions, or to a whole shape."""

from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]
_REACH = 2.0
"""Pixels to either side that the cubic filter reads, of the larger of both images."""
_BEND = -0.5
"""Of the cubic filter, as Pillow has it."""


def proportional(array: FloatArray, height: int, width: int, fit: str, fill: tuple[float, ...] = ()) -> FloatArray:
    """Images ``[..., C, h, w]`` as large as fit, and black beside them, as openpi and LeRobot resize them.

    Args:
        array: in 0..1.
        fit: ``start``: at the bottom and the right, bilinear, without smoothing what becomes smaller; ``centre``: so in
            the middle; ``bytes``: there, as Pillow's bilinear filter resizes bytes.
        fill: what is beside them in place of black, a number for each of the C channels.
    """
    before = array.shape[-2:]
    ratio = max(before[1] / width, before[0] / height)
    rows, columns = (max(int(n / ratio), 1) for n in before)
    small = _in_steps(array, rows, columns) if fit == "bytes" else _bilinear(_bilinear(array, rows, -2), columns, -1)
    top, left = height - rows, width - columns
    if fit != "start":
        small = np.clip(small, 0, 1)  # openpi clips what it resized
        top, left = top // 2, left // 2
    whole = np.zeros((*array.shape[:-2], height, width), np.float32)
    whole += np.asarray(fill or 0, np.float32).reshape(-1, 1, 1)
    whole[..., top : top + rows, left : left + columns] = small
    return whole


def in_bytes(array: FloatArray) -> FloatArray:
    """Numbers in 0..1 rounded down to steps of 1/255; those that are such steps stay."""
    return np.asarray(np.trunc(np.clip(array * np.float32(255), 0, 255)) / 255, np.float32)


def stretched(array: FloatArray, height: int, width: int) -> FloatArray:
    """Images ``[..., h, w]`` that fill the shape, as Pillow's cubic filter resizes bytes; in steps of 1/255.

    It is computed as PyTorch does, rounding included, so that no pixel is another step than in the original.
    """
    pixels = np.rint(in_bytes(array) * np.float32(255))
    if array.shape[-2:] != (height, width):
        pixels = _cubic(_cubic(pixels, width, -1), height, -2)
        pixels = np.rint(np.clip(pixels, 0, 255))
    return np.asarray(pixels / np.float32(255), np.float32)


def averaged(array: FloatArray, height: int, width: int) -> FloatArray:
    """Images ``[..., h, w]`` that fill the shape: each pixel the mean of all that it touches, as PyTorch's ``area``."""
    rows, columns = (_means(*each) for each in zip(array.shape[-2:], (height, width), strict=True))
    return np.asarray(rows @ array @ columns.T, np.float32)


def _in_steps(array: FloatArray, rows: int, columns: int) -> FloatArray:
    """Columns first, bytes after each, halves up; shares in steps of 2 ** -22, so every sum is exact."""
    pixels: npt.NDArray[np.floating[Any]] = np.rint(in_bytes(array) * np.float32(255))
    for axis, count in ((-1, columns), (-2, rows)):
        before = pixels.shape[axis]
        away = np.arange(before) + 0.5 - before / count * (np.arange(count)[:, None] + 0.5)
        shares = np.maximum(1 - np.abs(away) / max(before / count, 1), 0)
        shares = np.floor(shares / shares.sum(1, keepdims=True) * 2**22 + 0.5) / 2**22
        pixels = np.floor((pixels @ shares.T if axis == -1 else shares @ pixels) + 0.5)
    return np.asarray(pixels / 255, np.float32)


def _means(before: int, count: int) -> FloatArray:
    """``[count, before]``: the share that each old entry has in each new one."""
    new, old = np.arange(count)[:, None], np.arange(before)
    touched = (old >= new * before // count) & (old < -(-(new + 1) * before // count))
    return np.asarray(touched / touched.sum(1, keepdims=True), np.float32)


def _bilinear(array: FloatArray, count: int, axis: int) -> FloatArray:
    """One axis to ``count`` entries: each between the two old ones that its middle falls between."""
    before = array.shape[axis]
    if before == count:
        return array
    at = np.float32(before / count) * (np.arange(count, dtype=np.float32) + np.float32(0.5)) - np.float32(0.5)
    at = np.maximum(at, np.float32(0))
    low = np.minimum(at.astype(np.int64), before - 1)
    share = (at - low).astype(np.float32)
    share = share[:, None] if axis == -2 else share
    left, right = array.take(low, axis), array.take(np.minimum(low + 1, before - 1), axis)
    made: FloatArray = left * (1 - share) + right * share
    return made


def _cubic(array: FloatArray, count: int, axis: int) -> FloatArray:
    """One axis to ``count`` entries, each a weighted mean of those near its middle."""
    before = array.shape[axis]
    scale = np.float32(before) / np.float32(count)
    wide = max(scale, np.float32(1))
    reach = np.float32(_REACH) * wide
    middle = (float(scale) * (np.arange(count) + 0.5)).astype(np.float32)
    first = np.maximum((middle - reach + 0.5).astype(np.int64), 0)
    stop = np.minimum((middle + reach + 0.5).astype(np.int64), before)
    taps = np.arange(int((stop - first).max()))
    at = first[:, None] + taps - middle[:, None].astype(np.float64) + 0.5
    weights = _kernel((at * float(1 / wide)).astype(np.float32))
    weights[first[:, None] + taps >= stop[:, None]] = 0
    total = np.zeros(count, np.float32)
    for tap in taps:
        total += weights[:, tap]
    weights /= total[:, None]
    made: FloatArray = np.zeros((), np.float32)
    for tap in taps:
        row, share = array.take(np.minimum(first + tap, before - 1), axis), weights[:, tap]
        made = _fused(row, share[:, None] if axis == -2 else share, made)
    return made


def _kernel(x: FloatArray) -> FloatArray:
    """The weight of a pixel at a distance: a piece of a cubic up to 1, another up to 2."""
    x, a = np.abs(x), _BEND
    near = _fused(_fused(x, a + 2, -(a + 3)) * x, x, 1)
    far = _fused(_fused(_fused(x, a, -5 * a), x, 8 * a), x, -4 * a)
    return np.where(x < 1, near, np.where(x < 2, far, 0)).astype(np.float32)


def _fused(x: FloatArray, factor: FloatArray | float, more: FloatArray | float) -> FloatArray:
    """``x * factor + more``, rounded once, as processors do it: in float64 the product is exact."""
    return (x.astype(np.float64) * factor + more).astype(np.float32)
