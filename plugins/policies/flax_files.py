"""Trees of arrays as flax saves them, in msgpack, and the weights that torch makes of them, without flax or JAX.

Nothing in such a file runs. Sizes are known before anything is allocated: an array is a part of the file.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ttscompile.errors import CheckpointError
from ttscompile.frontends.saved_weights import require_memory_for

_ARRAY, _COMPLEX, _SCALAR = 1, 2, 3
"""Extensions of msgpack that flax has."""
_BFLOAT16 = "bfloat16"
_KINDS = frozenset(
    {"float16", "float32", "float64", "bool", *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64))}
)
_MOST_AXES = 16
_DEEP = 64
_MOST_ENTRIES = 100_000
"""Of a file; Octo has some 500."""
_OUTSIDE = "PLACEHOLDER://"
"""What orbax writes for an array that is in files of its own."""
_STANDARD = 1e-5

Tree = dict[str, Any]


def read_tree(path: Path, most: int | None = None) -> Tree:
    """Maps by name, of maps, arrays and plain values; bfloat16 as uint16.

    Args:
        most: bytes that the file may have; None if the machine's memory decides.

    Raises:
        CheckpointError: no such file, one that is too large or damaged, or no package msgpack.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file. Copy the directory whole.")
    size = path.stat().st_size
    if most is not None and size > most:
        raise CheckpointError(f"{path}: has {size:,} bytes; expected {most:,} at most. Copy it again.")
    if most is None:
        require_memory_for(path, [(size // 4, False)])
    try:
        import msgpack
    except ModuleNotFoundError as missing:
        raise CheckpointError(
            f"{path}: reading it needs the package msgpack, which is not installed. Install 'ttscompile[octo]'."
        ) from missing
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            limits = {"max_map_len": _MOST_ENTRIES, "max_array_len": _MOST_ENTRIES}
            found = msgpack.unpackb(data, ext_hook=_hook(msgpack.unpackb), object_hook=_counted(), **limits)
        return _checked(found, "", 0)
    except (ValueError, TypeError, RecursionError, OverflowError, msgpack.UnpackException) as error:
        told = f"{str(error)[:200] or type(error).__name__}"
        raise CheckpointError(
            f"{path}: not a msgpack file of flax, or a damaged one: {told}. Copy it again."
        ) from error


def _counted() -> Callable[[Tree], Tree]:
    """Gives back each map, until all of them have too many entries."""
    count = 0

    def hook(found: Tree) -> Tree:
        nonlocal count
        count += 1 + len(found)
        if count > _MOST_ENTRIES:
            raise ValueError(f"has more than {_MOST_ENTRIES:,} entries")
        return found

    return hook


def _hook(unpack: Callable[..., Any]) -> Callable[[int, bytes], Any]:
    def array(code: int, data: bytes) -> Any:
        if code not in (_ARRAY, _SCALAR):
            what = "a complex number" if code == _COMPLEX else f"an extension {code}"
            raise ValueError(f"holds {what}; expected arrays")
        shape, kind, content = unpack(data, raw=True)
        return _array(shape, kind, content)

    return array


def _array(shape: Any, kind: Any, content: Any) -> npt.NDArray[Any]:
    name = kind.decode("ascii", "replace") if isinstance(kind, bytes) else str(kind)
    if name not in _KINDS and name != _BFLOAT16:
        raise ValueError(f"an array of {name!r:.40}; expected numbers")
    sizes = isinstance(shape, list) and len(shape) <= _MOST_AXES and all(type(n) is int and n >= 0 for n in shape)
    if not sizes or not isinstance(content, bytes):
        raise ValueError(f"an array of shape {shape!r:.80}")
    found = np.frombuffer(content, np.uint16 if name == _BFLOAT16 else name)
    return found.reshape(shape)  # raises ValueError where it has other numbers


def _checked(found: Any, where: str, depth: int) -> Tree:
    if not isinstance(found, dict) or depth > _DEEP or not all(isinstance(name, str) for name in found):
        raise ValueError(f"{where or 'the file'} is a {type(found).__name__}; expected arrays by name")
    for name, value in found.items():
        if isinstance(value, dict):
            _checked(value, f"{where}{name}"[:200], depth + 1)
    return found


def leaves(tree: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """What is no map, by its path with dots."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def for_torch(tree: Mapping[str, Any], where: Path, remedy: str) -> dict[str, Tensor]:
    """Weights as torch has them: by the names of flax's modules, kernels as ``weight`` with outputs first.

    ``StdConv`` is standardised here, which the original does in every call.

    Raises:
        CheckpointError: what is no array, or is an array in a file of its own; ``remedy`` says what to do.
    """
    made = {}
    for path, value in leaves(tree):
        if isinstance(value, str) and value.startswith(_OUTSIDE):
            raise CheckpointError(f"{where}: {path:.200} is in files of its own (tensorstore). {remedy}")
        if not isinstance(value, np.ndarray):
            raise CheckpointError(f"{where}: {path:.200} is a {type(value).__name__}; expected an array. {remedy}")
        module, _, name = path.rpartition(".")
        array = _float32(value)
        if name == "kernel":
            array = _kernel(array, module)
        elif name == "bias":
            array = array.flatten()
        made[f"{module}.{'weight' if name in ('kernel', 'scale', 'embedding') else name}".lstrip(".")] = array
    return made


def _float32(value: npt.NDArray[Any]) -> Tensor:
    if value.dtype == np.uint16:  # bfloat16
        return torch.from_numpy((value.astype(np.uint32) << 16).view(np.float32))
    return torch.from_numpy(np.array(value, np.float32))


def _kernel(array: Tensor, module: str) -> Tensor:
    if array.ndim == 3:  # of attention, with an axis for heads
        array = array.flatten(0, 1) if module.endswith(".out") else array.flatten(1, 2)
    if ".StdConv_" in module and array.ndim == 4:
        array = array - array.mean((0, 1, 2))
        array = array / (array.std((0, 1, 2), correction=0) + _STANDARD)
    axes = {2: (1, 0), 4: (3, 2, 0, 1)}.get(array.ndim, range(array.ndim))
    return array.permute(*axes).contiguous()
