"""float32 weights in 16 bits: stored so where that changes no number, and made float32 where they are read.

bfloat16 is the upper half of a float32; numpy has no such type, so its numbers are integers here.
"""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.coercion import Array

SHORT: Mapping[str, np.dtype[Any]] = MappingProxyType({"BF16": np.dtype("<u2"), "F16": np.dtype("<f2")})
"""What a file of weights may have in place of float32, by safetensors' names."""

LEAST_SHORT = 2**12
"""Numbers of a weight that is stored so. Vectors save nothing, and onnxruntime looks for some of them."""

_PART = 2**18
"""Numbers that are looked at once: a weight may be a tenth of the memory."""


class ShortArray:
    """A float32 array that lies in 16 bits, with what says how large it is. ``np.asarray`` makes it, anew each time."""

    dtype = np.dtype("<f4")

    def __init__(self, stored: Array) -> None:
        self._stored, self.nbytes = stored, 2 * stored.nbytes
        self.shape, self.size, self.ndim = stored.shape, stored.size, stored.ndim

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> Array:
        if self._stored.dtype == SHORT["F16"]:
            return self._stored.astype(dtype or self.dtype)
        return np.left_shift(self._stored, 16, dtype="<u4").view(self.dtype).astype(dtype or self.dtype, copy=False)


def short_code(array: Array) -> str | None:
    """As what an array is stored in 16 bits, one of ``SHORT``; None where it stays as it is."""
    if array.dtype.newbyteorder("<") != ShortArray.dtype or array.size < LEAST_SHORT:
        return None
    for code in SHORT:  # bits are compared: a zero keeps its sign, and what is no number stays the same one
        both = ((np.asarray(ShortArray(short)), part) for part, short in parts(array, code))
        if all(np.array_equal(found.view("<u4"), part.view("<u4")) for found, part in both):
            return code
    return None


def parts(array: Array, code: str) -> Iterator[tuple[Array, Array]]:
    """The numbers of an array in their order, some at a time: in float32, and what they are in 16 bits."""
    numbers = array.reshape(-1)
    for i in range(0, len(numbers), _PART):
        part = np.asarray(numbers[i : i + _PART], ShortArray.dtype)
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            short = part.astype(SHORT[code]) if code == "F16" else (part.view("<u4") >> 16).astype(SHORT[code])
        yield part, short
