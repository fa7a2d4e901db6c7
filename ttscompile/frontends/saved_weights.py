"""Saved weights: reading them, and whether they are those of a network; said in the same words, whoever saved them."""

import math
import mmap
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import nn

from ..errors import CheckpointError
from ..measure.machine import memory_bytes

BYTES_A_WEIGHT, BYTES_A_COPY = 2, 4
"""That compiling takes at most, beside the mapped file; copies are of weights that were not saved in float32. Source:
``docs/decisions.md``."""
_LEAST_MAPPED = 2**28
"""Bytes of copies; fewer are held in memory."""

Network = TypeVar("Network", bound=nn.Module)

SHOWN = 6
"""Names that a message holds; it counts the others."""


def read_tensors(path: Path) -> dict[str, torch.Tensor]:
    """The tensors of a safetensors file on the CPU; the format holds nothing that could run."""
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file. Copy the policy's directory whole.")
    try:
        tensors: dict[str, torch.Tensor] = load_file(path, device="cpu")
    except Exception as error:  # what the reader raises depends on where the file is damaged
        what = "not a safetensors file, or a truncated one"
        raise CheckpointError(f"{path}: {what}: {error!s:.300}. Copy it again.") from error
    return tensors


def left_out(name: str, without: tuple[str, ...]) -> bool:
    """Whether a weight is one of those whose names end so, or hold a part that ends with a dot."""
    return name.endswith(without) or any(part in name for part in without if part.endswith("."))


def require_memory(path: Path, without: tuple[str, ...] = ()) -> None:
    """Raise unless the machine has the memory that compiling these weights takes; before anything is read."""
    if not path.is_file():
        return
    try:
        with safe_open(path, "np") as file:
            names = [name for name in file.keys() if not left_out(name, without)]  # noqa: SIM118
            sizes = [saved_size(file, name) for name in names]
    except Exception:  # a damaged file, which its reader describes
        return
    require_memory_for(path, sizes)


def require_memory_for(path: Path, sizes: Iterable[tuple[int, bool]]) -> None:
    """The same of tensors that the file at ``path`` has: how many numbers each has, and whether it is float32."""
    sizes = list(sizes)
    numbers, copied = sum(count for count, _ in sizes), BYTES_A_COPY * sum(n for n, single in sizes if not single)
    (folder, room), there = disk_room(), memory_bytes()
    need = BYTES_A_WEIGHT * numbers + copied * (not _LEAST_MAPPED <= copied <= room)
    if need > there:
        disk = f"{copied / 2**30:.1f} GiB of it can be on disk: {folder} has no room, so set TMPDIR. Or: "
        remedy = disk * (copied > max(room, _LEAST_MAPPED))
        remedy += "Convert on a larger machine: in precision 'int4' the artifact takes about a byte a weight to run."
        raise CheckpointError(
            f"{path}: {numbers / 1e6:,.0f} million weights. Compiling them takes about {need / 2**30:.1f} GiB of memory"
            f" beside the file; this machine has {there / 2**30:.1f} GiB. {remedy}"
        )


def saved_size(file: Any, name: str) -> tuple[int, bool]:
    """The same of a tensor in an open safetensors file."""
    one = file.get_slice(name)
    return math.prod(one.get_shape()), one.get_dtype() == "F32"


def names_of(keys: Sequence[str]) -> str:
    """A few names and how many more there are."""
    more = f" and {len(keys) - SHOWN} more" if len(keys) > SHOWN else ""
    return ", ".join(keys[:SHOWN]) + more


def renamed(name: str, rules: Sequence[tuple[str, str]]) -> str:
    """The name after all of these patterns and what they become, one after the other."""
    for pattern, new in rules:
        name = re.sub(pattern, new, name)
    return name


def separated(name: str, value: torch.Tensor) -> dict[str, torch.Tensor]:
    """Weights of ``qkv`` as those of ``q_proj``, ``k_proj`` and ``v_proj``; what has no thirds stays whole, in each."""
    thirds = value.chunk(3) if value.ndim and len(value) % 3 == 0 else [value] * 3
    return {name.replace(".qkv.", f".{one}_proj."): each.clone() for one, each in zip("qkv", thirds, strict=True)}


def as_float32(weights: Mapping[str, Any], where: str = "") -> dict[str, torch.Tensor]:
    """Weights of any floating-point type, under the names that a network without wrappers gives them."""
    for name, value in weights.items():
        if not isinstance(value, torch.Tensor) or value.layout != torch.strided or not value.is_floating_point():
            what = f"{value.dtype} tensor" if isinstance(value, torch.Tensor) else type(value).__name__
            raise CheckpointError(f"{where}weight {name} is a {what}; expected a dense floating-point tensor.")
    # Without the levels that torch.compile and DistributedDataParallel put around a network.
    parts = {name: [part for part in str(name).split(".") if part not in ("_orig_mod", "module")] for name in weights}
    copies = _copies({name: value for name, value in weights.items() if value.dtype != torch.float32})
    return {".".join(parts[name]): copies.get(name, value.detach()) for name, value in weights.items()}


def _copies(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The weights in float32. Many are in a file without a name: the system takes their pages back as it needs room."""
    size = BYTES_A_COPY * sum(value.numel() for value in weights.values())
    if size < _LEAST_MAPPED:
        return {name: value.detach().to(torch.float32) for name, value in weights.items()}
    try:
        with tempfile.TemporaryFile(dir=disk_room()[0]) as file:
            os.posix_fallocate(file.fileno(), 0, size)  # a disk that is full later would end the process
            numbers = torch.frombuffer(mmap.mmap(file.fileno(), size), dtype=torch.float32)
    except (OSError, AttributeError):  # macOS does not reserve
        numbers = torch.empty(size // BYTES_A_COPY)
    found, end = dict[str, torch.Tensor](), 0
    for name, value in weights.items():
        start, end = end, end + value.numel()
        found[name] = numbers[start:end].view(value.shape).copy_(value.detach())
    return found


def disk_room() -> tuple[str, int]:
    """Where large files for a while are put, and the bytes there; ``/tmp`` is memory on many machines."""
    large = Path("/var/tmp")  # noqa: S108 - what tempfile makes there has no name
    folder = os.environ.get("TMPDIR") or (str(large) if large.is_dir() else tempfile.gettempdir())
    usable = hasattr(os, "posix_fallocate") and os.access(folder, os.W_OK | os.X_OK)
    return folder, shutil.disk_usage(folder).free if usable else 0


def filled(make: Callable[[], Network], weights: Mapping[str, torch.Tensor], source: str, where: Path) -> Network:
    """A network with these weights, which are compared before anything of the configured sizes takes memory.

    ``where`` begins the message of an error; see ``require_weights``.
    """
    try:
        with torch.device("meta"):
            network = make()
        require_weights(network.state_dict(), weights, source)
    except CheckpointError as error:
        raise CheckpointError(f"{where}: {error}") from error
    network.load_state_dict(weights, assign=True)
    return network


def require_weights(
    expected: Mapping[str, torch.Tensor],
    found: Mapping[str, torch.Tensor],
    source: str,
    masks: Collection[str] = (),
    what: str = "the weights do not fit the configuration",
) -> None:
    """Raise unless every weight is there, of the right shape and finite, and nothing else is there.

    Args:
        expected: by name, on any device: only shapes are looked at.
        source: of the expected shapes, for messages; the configuration or a part of it.
        masks: names of what may hold infinity.
        what: is wrong where names are missing or unknown; begins the message.
    """
    missing, extra = [name for name in expected if name not in found], [name for name in found if name not in expected]
    if missing or extra:
        parts = [f"missing {names_of(missing)}"] * bool(missing) + [f"unexpected {names_of(extra)}"] * bool(extra)
        raise CheckpointError(
            f"{what}: {'; '.join(parts)}. What was saved is another network than {source} describes, or the file is"
            " incomplete; ttscompile.compile_denoiser(module, spec) takes any network."
        )
    for name, value in found.items():
        if value.shape != expected[name].shape:
            shapes = f"{tuple(value.shape)}; expected {tuple(expected[name].shape)}"
            raise CheckpointError(f"weight {name} has shape {shapes}, which {source} describes.")
        # The extremes are no number where any is none; asking each number would take more memory than all of them have.
        if name not in masks and value.numel() and not torch.isfinite(torch.stack(torch.aminmax(value))).all():
            count = int((~torch.isfinite(value)).sum())
            raise CheckpointError(f"weight {name} holds {count} values that are not finite; training diverged.")
