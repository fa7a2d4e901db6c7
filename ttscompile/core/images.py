"""Images of any size as the policy takes them: resized with their proportions, the rest black. Numpy only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..errors import ObservationError
from .coercion import Array, Errors
from .spec import ObservationSpec
from .values import check_values


def fitted(array: Array, spec: ObservationSpec, what: str = "an image", error: Errors = ObservationError) -> Array:
    """An image of another size as the specification has it; anything else as it is.

    What openpi and LeRobot do: bilinear, without smoothing what becomes smaller.

    Args:
        array: ``[..., C, h, w]``.
        spec: of the observation, of a window or of a frame.
        what: for the message, ``observation 'obs'``.
        error: class of the error.

    Raises:
        TtscompileError: of the class ``error``: what would be resized is not finite, or outside of its bounds.
    """
    if spec.fit is None or array.dtype != np.float32 or array.ndim < 3 or not array.size:
        return array
    channels, height, width = spec.shape[-3:]
    if array.shape[-3] != channels or array.shape[-2:] == (height, width):
        return array
    array = array.copy()  # another thread may write into the caller's
    check_values(array, replace(spec, normalizer=None), what, error)  # what is resized is clipped, and looks right
    before = array.shape[-2:]
    ratio = max(before[1] / width, before[0] / height)
    rows, columns = (max(int(n / ratio), 1) for n in before)
    small = _resized(_resized(array, rows, -2), columns, -1)
    if spec.fit == "centre":
        small = np.clip(small, 0, 1)  # openpi clips what it resized
    top, left = height - rows, width - columns
    if spec.fit == "centre":
        top, left = top // 2, left // 2
    whole = np.zeros((*array.shape[:-2], height, width), np.float32)
    whole[..., top : top + rows, left : left + columns] = small
    return whole


def _resized(array: npt.NDArray[np.float32], count: int, axis: int) -> npt.NDArray[np.float32]:
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
    made: npt.NDArray[np.float32] = left * (1 - share) + right * share
    return made
