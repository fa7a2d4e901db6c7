"""Readers of the checkpoints that users have: each gives a module and a ``PolicySpec``; nothing after it differs.

Whatever a checkpoint lacks, or has that is not rebuilt here, is a ``CheckpointError`` of any function of this room; a
sampler, spacing or number of steps that was asked for and cannot be is a ``SpecError``.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.paths import on_hub, require_free_or_path
from ..core.spec import PolicySpec
from ..core.tokenizer import Tokenizer
from ..errors import CheckpointError
from ..hub import fetch_checkpoint
from .families import AS_SAVED, LoadOptions, find_family, function_of

if TYPE_CHECKING:
    from torch import nn


def load_checkpoint_policy(
    path: str | os.PathLike[str], format: str = "auto", options: LoadOptions = AS_SAVED
) -> tuple[nn.Module, PolicySpec]:
    """Load a trained policy without the code that trained it, and without running anything from the file.

    Args:
        format: name of a row of ``families.FAMILIES``; ``auto`` tells by what is there.
        options: what is asked for in place of what the checkpoint says.

    Returns:
        The denoiser in eval mode, which takes the sample ``[B, T, D]``, the timestep ``[B]`` and the observations,
        normalised as the second result says, and everything else about the policy. What the original evaluates once a
        call is the ``encoder`` of an ``EncodedDenoiser``.

    Raises:
        CheckpointError: unreadable, unsafe, not a supported policy, or given an option of another family.
        SpecError: the sampler asked for is not possible.
    """
    require_free_or_path(path, CheckpointError, "Give a file or a directory that was trained.")
    return find_family(Path(path), format).load(Path(path), options)


def recordings_of(path: str | os.PathLike[str], format: str = "auto") -> str:
    """Where the recorded episodes are that a policy was trained on, as ``load_trajectories`` takes it.

    Raises:
        CheckpointError: the checkpoint does not say, or names what is not here.
        HubError: the checkpoint is on the hub, and cannot be had.
    """
    here = fetch_checkpoint(str(path)).path if on_hub(path) else Path(path)
    find = find_family(here, format).function("recordings")
    found: str | None = None if find is None else find(here)
    if found is None:
        told = "does not say which data set it was trained on. Give recorded episodes of its robot, with --trajectories"
        raise CheckpointError(f"{os.fspath(path)}: {told}.")
    return found


def tokenizer_of(
    path: str | os.PathLike[str], spec: PolicySpec, encoders: str | os.PathLike[str] | None
) -> tuple[bytes | None, str]:
    """The ``tokenizer.json`` that makes an instruction a policy's tokens; and which that is, or why there is none.

    One that belongs to another language model is none: it knows more tokens than the policy does.
    """
    if spec.instruction is None:
        return None, "no text alone gives what this policy observes"
    find, bounds = function_of(spec, "tokenizer_file"), spec.observations[spec.instruction.tokens].bounds
    try:
        file = None if find is None else find(Path(path), encoders)
        if file is None or bounds is None:
            return None, "that of its language model is not on this machine"
        found = Tokenizer(file, CheckpointError)
    except CheckpointError as error:
        return None, str(error).removesuffix(".")
    known = round(float(np.max(bounds[1]))) + 1
    if found.size > known:
        return None, f"{file} has {found.size} tokens, of which the policy knows {known}"
    return found.json, f"{file}: {found.size} tokens"


def files_beside(path: str | os.PathLike[str], spec: PolicySpec, text: bool) -> dict[str, bytes] | None:
    """Files by which the program that trained a policy takes the compiled one in its place.

    None where it never can; empty where it cannot take this one. ``text``: the compiled one makes tokens of its task.
    """
    own = function_of(spec, "files_beside")
    return None if own is None else own(Path(path), spec, text)
