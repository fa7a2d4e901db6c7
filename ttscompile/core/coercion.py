"""What callers give, made plain or refused: an int, or a numpy array of numpy's own class whose every number counts.

Arrays of other libraries keep more than numbers: a mask, a unit, an operation of their own. Numpy's functions follow
that, and the code that computes does not; so it is refused here, or left behind where it changes nothing. Torch's
tensors are known without importing torch.
"""

import operator
import sys
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..errors import TtscompileError

Array: TypeAlias = npt.NDArray[Any]
Arrays: TypeAlias = Mapping[str, Array]
"""By name."""
Errors: TypeAlias = type[TtscompileError]


def integer(value: Any, what: str, error: Errors, least: int = 0, most: int | None = None, more: str = "") -> int:
    """A whole number, whatever says that it is one: of Python, numpy or torch, an array of no axes; not a bool.

    Args:
        what: the name of the argument.
        least: the smallest that is taken.
        most: the largest; None for no limit.
        more: what else is taken, for the message.
    """
    try:
        boolean = isinstance(value, bool) or str(getattr(value, "dtype", "")).endswith("bool")
        number = None if boolean else operator.index(value)
    except Exception:  # of what claims to be one, torch's tensors without a number among them
        number = None
    if number is None or number < least or (most is not None and number > most):
        limit = "" if most is None else f" and at most {most}"
        raise error(f"{what} must be an integer of at least {least}{limit}{more}; found {value!r:.80}.")
    return number


def is_tensor(value: object) -> bool:
    """Whether this is a torch tensor; if torch was never imported, nothing is."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def plain(value: Any, what: str, error: Errors, dtype: str = "float32") -> Array:
    """The numpy array of an array or a tensor, of numpy's own class; no copy if it can be helped.

    For the message, ``what`` is ``observation 'obs'``, and ``dtype`` what is expected in the end; it is not checked.

    Raises:
        TtscompileError: of the class ``error``: neither an array nor a tensor; a masked array, or one that computes in
            its own way; or a tensor whose numbers numpy cannot have.
    """
    if type(value) is np.ndarray:
        return value
    if isinstance(value, np.ndarray):
        return _without_class(value, what, error, dtype)
    if is_tensor(value):
        try:
            array = value.numpy(force=True)
        except Exception as failure:
            raise error(f"{what} is a tensor {_trouble(value, failure, dtype)}") from failure
        return plain(array, what, error, dtype)
    expected = f"expected a numpy array or a torch tensor. Use np.asarray(..., dtype=np.{dtype})."
    raise error(f"{what} is a {type(value).__name__}; {expected}")


def listed(value: Any, what: str, error: Errors, dtype: str) -> Array:
    """The same, of lists and tuples of numbers or of arrays too, and of all that ``np.asarray`` takes."""
    if isinstance(value, np.ndarray) or is_tensor(value):
        return plain(value, what, error, dtype)
    try:
        return np.asarray(_rows(value, what, error, dtype))
    except TtscompileError:
        raise
    except Exception as failure:  # of numpy, or of the object itself
        raise error(f"{what} is no array of numbers ({failure!s:.200}); expected {dtype}.") from failure


def numbers(value: Any, what: str, error: Errors, dtype: str = "float32") -> Array:
    """The same as numbers of a dtype; what that cannot hold becomes infinite."""
    array = listed(value, what, error, dtype)
    if array.dtype.kind not in "biuf":
        raise error(f"{what} has dtype {array.dtype!s:.80}; expected numbers, {dtype}.")
    with np.errstate(over="ignore"):
        return array.astype(dtype)


def _rows(value: Any, what: str, error: Errors, dtype: str) -> Any:
    if isinstance(value, list | tuple):
        return [_rows(one, what, error, dtype) for one in value]
    return plain(value, what, error, dtype) if isinstance(value, np.ndarray) or is_tensor(value) else value


def _without_class(array: Array, what: str, error: Errors, dtype: str) -> Array:
    kind = type(array)
    if isinstance(array, np.ma.MaskedArray):
        remedy = "Give plain numbers, such as array.filled(value) with a value that the policy knows from training"
        raise error(f"{what} is a masked array, and there is no telling what its numbers under the mask are. {remedy}.")
    if kind.__array_ufunc__ is not np.ndarray.__array_ufunc__:
        problem = f"{what} is a {kind.__name__}, whose numbers mean what its own operations make of them"
        raise error(f"{problem}; expected a plain array. Use np.array(..., dtype=np.{dtype}), in the policy's units.")
    return np.ndarray.view(array, np.ndarray)


def _trouble(tensor: Any, failure: Exception, dtype: str) -> str:
    """What keeps numpy from the numbers of a tensor, and what to do; after "is a tensor"."""

    def told(name: str) -> str:
        try:
            return str(getattr(tensor, name))
        except Exception:  # some tensors refuse to be asked
            return ""

    plainly = f"Give a plain tensor of numbers: {dtype}, dense, on the CPU or a GPU."
    if told("is_nested") == "True":
        return f"that is nested, whose rows differ in length. {plainly}"
    if told("layout") not in ("", "torch.strided"):
        return f"of the layout {told('layout')}; expected a dense one. Use .to_dense()."
    if told("device") == "meta":
        return f"on the device meta, where there are no numbers. {plainly}"
    if told("is_quantized") == "True":
        return f"of dtype {told('dtype')}, which numpy does not have. Use .dequantize()."
    if isinstance(failure, TypeError):
        return f"of dtype {told('dtype')}, which numpy does not have. Convert it with .to(torch.{dtype})."
    kind = type(tensor).__name__
    if kind not in ("Tensor", "Parameter"):
        return f"of the class {kind}, whose numbers numpy cannot have. {plainly}"
    remedy = "Call the policy outside of torch.vmap, torch.func and torch.compile"
    return f"whose numbers cannot be read here ({str(failure).splitlines()[0]:.100}). {remedy}."
