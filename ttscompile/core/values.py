"""What the numbers of an observation may be, wherever they come from: a call, a frame, a recording."""

from dataclasses import replace

import numpy as np

from ..errors import ObservationError
from .coercion import Array, Errors
from .pictures import averaged, proportional, stretched
from .spec import LARGEST, Affine, ObservationSpec


def check_values(array: Array, spec: ObservationSpec, what: str, error: Errors) -> None:
    """Raise unless the numbers of an observation are such that a policy can have been trained with.

    They are finite, and normalised not above ``LARGEST``; tokens and images are within their bounds. Images may
    overshoot by a tenth of the range, as resizing with a cubic filter does at edges. One of 0..255 in place of 0..1
    would give actions that look like actions.
    """
    tokens = spec.bounds is not None and array.dtype.kind in "iu"
    if array.dtype.kind == "f" or spec.normalizer is not None:
        remedy = "Look for the sensor, the unit or the division that made it."
        least, most = check_numbers(array, spec.normalizer, what, remedy, error)
    if spec.bounds is None or not (spec.image or tokens):
        return
    low, high = (np.asarray(each) for each in spec.bounds)
    if tokens:
        if (array < low).any() or (array > high).any():
            found = f"integers of {low.min():.0f} to {high.max():.0f}; found {array.min()} to {array.max()}"
            remedy = "Tokens must come from the tokenizer that the policy was trained with."
            raise error(f"{what} must hold {found}. {remedy}")
        return
    room = 0.1 * float(high[0] - low[0])
    if least < low[0] - room or most > high[0] + room:
        remedy = "Give what the camera measures, not normalised: the policy does that itself."
        if most > high[0] + room and least >= 0 and high[0] == 1:
            remedy = "Divide by 255, channels first."
        found = f"numbers of {low[0]:g} to {high[0]:g}; found {least:.6g} to {most:.6g}"
        raise error(f"{what} is an image and must hold {found}. {remedy}")


def check_numbers(
    array: Array, normalizer: Affine | None, what: str, remedy: str, error: Errors
) -> tuple[float, float]:
    """The least and the largest number, zeros for none. Raise unless finite, and normalised within ``LARGEST``."""
    if not array.size:
        return 0.0, 0.0
    least, most = float(array.min()), float(array.max())
    reach = LARGEST if normalizer is None else normalizer.reach
    if -reach <= least and most <= reach:  # not so if any is NaN
        return least, most
    wrong, expected, normalised = ~np.isfinite(array), "finite", ""
    if not wrong.any():
        with np.errstate(all="ignore"):
            values = array if normalizer is None else normalizer.normalize(array)
        wrong, expected = ~(np.abs(values) <= LARGEST), f"between -{LARGEST:g} and {LARGEST:g}"
        if not wrong.any():
            return least, most
        if normalizer is not None:
            expected, normalised = f"{expected} when normalised", f" ({values[wrong][0]:.6g} when normalised)"
    first = tuple(np.argwhere(wrong)[0].tolist())
    found = f"{array[first]:.6g} at index {first}{normalised}, {np.count_nonzero(wrong)} such values in all"
    raise error(f"{what} must be {expected}; found {found}. {remedy}")


def fitted(array: Array, spec: ObservationSpec, what: str = "an image", error: Errors = ObservationError) -> Array:
    """An image of another size as the specification has it; anything else as it is.

    Args:
        array: ``[..., C, h, w]``.
        spec: of the observation, of a window or of a frame.
        what: for the message, ``observation 'obs'``.

    Raises:
        TtscompileError: of the class ``error``: what would be resized is not finite, or outside of its bounds.
    """
    if spec.fit is None or array.dtype != np.float32 or array.ndim < 3 or not array.size:
        return array
    channels, height, width = spec.shape[-3:]
    if array.shape[-3] != channels or (array.shape[-2:] == (height, width) and spec.fit != "stretch"):
        return array
    array = array.copy()  # another thread may write into the caller's
    check_values(array, replace(spec, normalizer=None), what, error)  # what is resized is clipped, and looks right
    if spec.fit in ("stretch", "average"):
        return (stretched if spec.fit == "stretch" else averaged)(array, height, width)
    return proportional(array, height, width, spec.fit, spec.fill)
