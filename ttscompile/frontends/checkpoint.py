"""Reading a torch checkpoint without running anything that it contains.

A ``.ckpt`` of Diffusion Policy is a torch zip whose pickle names classes of omegaconf and a function of dill. They are
answered by the inert stand-ins below, so neither package is needed and neither runs; any other name outside torch's
own list is refused before a single object is built.
"""

import itertools
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

from ..core.zip_files import open_zip
from ..errors import CheckpointError

_DEEPEST = 64  # nesting of a configuration; a real one has about 6 levels, a cycle has no end
_HYDRA = ("_convert_", "_recursive_")  # how hydra is to instantiate what the other entries describe
_MOST_VALUES = 100_000  # of a configuration; a real one has about 300, one whose parts are shared can have 2^60


class _Inert:
    """Stand-in for a pickled class: keeps the state that it is given, and does nothing."""

    def __setstate__(self, state: object) -> None:
        self.state = state


class _Container(_Inert):
    """Stand-in for omegaconf's DictConfig and ListConfig; the data is in ``state["_content"]``."""


class _Node(_Inert):
    """Stand-in for omegaconf's value nodes; the data is in ``state["_val"]``."""


def _defaults(factory: object = None) -> dict[Any, Any]:
    """Stand-in for ``collections.defaultdict`` inside the metadata; its factory is dropped."""
    return {}


_BUILTIN_TYPES: Mapping[str, type] = {
    t.__name__: t for t in (dict, list, tuple, set, int, float, bool, str, bytes, complex, object, type(None))
}


def _load_type(name: str) -> type:
    """Stand-in for ``dill._dill._load_type``: the plain built-in types that a configuration can hold."""
    if not isinstance(name, str) or name not in _BUILTIN_TYPES:
        raise CheckpointError(
            f"the checkpoint asks dill for the type {name!r}; expected one of {sorted(_BUILTIN_TYPES)}. Nothing of the"
            " file was executed. Only load checkpoints that you trust, or save it again without dill."
        )
    return _BUILTIN_TYPES[name]


_STAND_INS: list[Callable[..., Any] | tuple[Callable[..., Any], str]] = [
    *((_Container, f"omegaconf.{kind.lower()}.{kind}") for kind in ("DictConfig", "ListConfig")),
    *((_Node, f"omegaconf.nodes.{kind}Node") for kind in ("Any", "Boolean", "Float", "Integer", "String")),
    # What omegaconf notes beside the data is never read.
    *((_Inert, name) for name in ("omegaconf.base.Metadata", "omegaconf.base.ContainerMetadata", "typing.Any")),
    *((_Inert, f"builtins.{name}") for name in _BUILTIN_TYPES),
    (_defaults, "collections.defaultdict"),
    (_load_type, "dill._dill._load_type"),
]


def read_checkpoint(path: str | os.PathLike[str], mapped: bool = False) -> dict[str, Any]:
    """Read a torch zip checkpoint; tensors on the CPU, configuration objects as inert stand-ins.

    Entries that are pickles of their own (``pickles``) stay the bytes they are. Tensors that are ``mapped`` stay in the
    file until they are used, as those of safetensors do.

    Raises:
        CheckpointError: missing, truncated, not a torch zip, or naming a global that is not known to be harmless.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file; expected a checkpoint saved by torch.save.")
    if not zipfile.is_zipfile(path):
        raise CheckpointError(
            f"{path}: not a torch checkpoint, or a truncated one: expected a zip archive as torch.save writes it, found"
            f" {path.stat().st_size} bytes without a zip directory. Copy the file again, or save it with torch >= 1.6."
        )
    try:
        _require_stored(path)
        with safe_globals(_STAND_INS):
            unknown = sorted(get_unsafe_globals_in_checkpoint(path))
            if unknown:
                raise CheckpointError(
                    f"{path}: refused, because its pickle names {', '.join(unknown)}, which could run code while"
                    " loading. Nothing of the file was executed. Save the checkpoint again without these objects."
                )
            payload = torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
    except CheckpointError:
        raise
    except Exception as error:  # a damaged directory or pickle; of whatever kind
        raise _unreadable(path, error) from error
    if not isinstance(payload, dict):
        raise CheckpointError(f"{path}: holds a {type(payload).__name__}; expected a dictionary.")
    _require_own_data(path, payload)
    return payload


def _require_stored(path: Path) -> None:
    """Raise if reading the archive could take more memory than the file has bytes: ``torch.save`` never compresses."""
    with path.open("rb") as file, open_zip(file) as archive:
        entries = archive.infolist()
    compressed = [entry.filename for entry in entries if entry.compress_type != zipfile.ZIP_STORED]
    total, size = sum(entry.file_size for entry in entries), path.stat().st_size
    if compressed or total > size:
        raise CheckpointError(
            f"{path}: expected entries that are stored as they are, as torch.save writes them; found"
            f" {len(compressed)} compressed ones and {total} bytes in a file of {size}. Save the checkpoint again."
        )


def _require_own_data(path: Path, payload: object) -> None:
    """Raise unless every tensor is a plain one on the CPU with as many bytes behind it as its shape says.

    A tensor of stride 0 has any shape on four bytes; the first operation on it takes the memory that it pretends to.
    """
    pending, seen = [payload], set()
    while pending:
        value = pending.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, torch.Tensor):
            plain = value.layout == torch.strided and value.device.type == "cpu" and not value.is_quantized
            if not plain or value.numel() * value.element_size() > value.untyped_storage().nbytes():
                what = f"{value.dtype}, {value.layout}, {list(value.shape)} on {value.device.type}"
                raise CheckpointError(
                    f"{path}: expected dense tensors with data of their own; found one of {what}. Save the checkpoint"
                    " again with tensors that are contiguous."
                )
        elif isinstance(value, dict):
            pending += [*value.keys(), *value.values()]
        elif isinstance(value, (list, tuple, set, frozenset)):
            pending += value
        elif isinstance(value, _Inert):
            pending.append(getattr(value, "state", None))


def _unreadable(path: Path, error: Exception) -> CheckpointError:
    """A damaged or foreign archive, in one line: torch's own pages of text advise to switch the protection off."""
    lines = str(error).strip().splitlines() or [""]
    exact = [line.split("WeightsUnpickler error:", 1)[1] for line in lines if "WeightsUnpickler error:" in line]
    reason = (exact or lines)[0].strip().rstrip(".") + "."
    return CheckpointError(
        f"{path}: cannot be read as a torch checkpoint ({type(error).__name__}: {reason}) Nothing of the file was"
        " executed. It is damaged, or not written by torch.save: copy it again, or save it again."
    )


def plain_config(value: Any, where: str = "cfg", depth: int = 0, values: Iterator[int] | None = None) -> Any:
    """Turn inert configuration objects into dictionaries, lists, strings, numbers, booleans and None."""
    values = itertools.count() if values is None else values
    if depth > _DEEPEST:
        raise CheckpointError(f"{where}: the configuration is nested deeper than {_DEEPEST} levels; it is malformed.")
    if next(values) > _MOST_VALUES:
        raise CheckpointError(f"{where}: the configuration has more than {_MOST_VALUES} values; it is malformed.")
    if isinstance(value, (_Container, _Node)):
        key = "_content" if isinstance(value, _Container) else "_val"
        state = getattr(value, "state", None)
        if not isinstance(state, dict) or key not in state:
            raise CheckpointError(f"{where}: a configuration object without {key}; the checkpoint is malformed.")
        return plain_config(state[key], where, depth + 1, values)
    if isinstance(value, dict):
        items = {str(name): item for name, item in value.items() if name not in _HYDRA}
        return {name: plain_config(item, f"{where}.{name}", depth + 1, values) for name, item in items.items()}
    if isinstance(value, (list, tuple)):
        return [plain_config(item, f"{where}[{i}]", depth + 1, values) for i, item in enumerate(value)]
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    found = type(value).__name__
    raise CheckpointError(f"{where}: found a {found}; expected dictionaries, lists, strings, numbers or None.")
