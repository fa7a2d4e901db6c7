"""Weights in safetensors files as transformers' ``save_pretrained`` writes them, of which a head is a part."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import safe_open

from ttscompile.errors import CheckpointError
from ttscompile.frontends.saved_weights import left_out, names_of, require_memory_for, saved_size
from ttscompile.frontends.settings import read_json

WHOLE, INDEX = "model.safetensors", "model.safetensors.index.json"

Taken = TypeVar("Taken")


def read_part(directory: Path, prefix: str, *without: str) -> dict[str, torch.Tensor]:
    """The tensors whose names begin so, without that beginning; the others are not read, nor those ``left_out``.

    Where no name begins so, all of them: the part was saved alone.
    """
    files = {name: file for name, file in _files(directory).items() if not left_out(name, without)}
    part = {name: file for name, file in files.items() if name.startswith(prefix)} or files
    by_file = {file: [name for name, each in part.items() if each == file] for file in sorted(set(part.values()))}
    sizes = [_take(file, saved_size, by_file[file]) for file in by_file]
    require_memory_for(directory, [size for each in sizes for size in each.values()])
    found: dict[str, torch.Tensor] = {}
    for file, names in by_file.items():
        found |= _take(file, lambda opened, name: opened.get_tensor(name), names)
    return {name.removeprefix(prefix): value for name, value in found.items()}


def _files(directory: Path) -> Mapping[str, Path]:
    """Every tensor's name, and the file that has it."""
    index, whole = directory / INDEX, directory / WHOLE
    if not index.is_file():
        return _take(whole, lambda opened, name: whole)
    names = read_json(index).get("weight_map")
    if not isinstance(names, dict) or not all(isinstance(file, str) for file in names.values()):
        raise CheckpointError(f"{index}: weight_map is {names!r:.80}; expected files by name. Copy it again.")
    for file in sorted(set(names.values())):
        if Path(file).name != file:
            raise CheckpointError(f"{index}: names {file!a:.80}; expected a file of its own directory. Copy it again.")
    return {name: directory / file for name, file in names.items()}


def _take(file: Path, take: Callable[[Any, str], Taken], names: list[str] | None = None) -> dict[str, Taken]:
    """Something of each tensor of a file that is named, or of all."""
    if not file.is_file():
        raise CheckpointError(f"{file}: no such file. {_remedy(file)}")
    try:
        with safe_open(file, "pt") as opened:
            return {name: take(opened, name) for name in (opened.keys() if names is None else names)}
    except Exception as error:  # what the reader raises depends on where the file is damaged
        what = "not a safetensors file, a truncated one, or one without the tensors that its index names"
        raise CheckpointError(f"{file}: {what}: {error!s:.300}. Copy it again.") from error


def _remedy(missing: Path) -> str:
    """What to do without these weights: transformers puts those of a training in folders, and once pickled them."""
    directory = missing.parent
    saved = sorted(each.name for each in directory.glob("checkpoint-*") if each.is_dir())
    pickled = sorted(each.name for each in directory.glob("pytorch_model*.bin"))
    if missing.name != WHOLE or not (saved or pickled):
        return "Copy the directory whole."
    if saved:
        return f"Give a folder in it that the training saved: {names_of(saved)}."
    return f"It has {names_of(pickled)}; safetensors are expected: load the model, and save_pretrained it again."
