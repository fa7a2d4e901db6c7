"""What lerobot saves beside a policy's network, and what of it goes wrong on a robot without an error."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..core.finding import Finding, Level
from ..core.spec import PolicySpec
from ..core.tokenizer import Tokenizer, find_tokenizer
from ..errors import CheckpointError
from .instruction import encoder_folders
from .lerobot_config import ACTION, CONFIG
from .lerobot_policy import TOKENS
from .lerobot_processors import NORMALIZE, PREPROCESSOR, Features, Processors, Statistics, read_processors
from .saved_weights import read_tensors
from .settings import read_json

PART = "checkpoint"
REPEAT = "Compute the statistics again on the data that the policy was trained with, and save it with them."
_IMAGES = "observation.images."


def saved_statistics(directory: Path) -> dict[str, Statistics]:
    """See ``statistics``."""
    found = read_processors(directory, _features(read_json(directory / CONFIG)))
    made = {found.renamed.get(key, key): one for key, one in found.normalizers.items() if key != ACTION}
    return made if found.action is None else made | {ACTION: found.action}


def examine_lerobot(directory: Path, spec: PolicySpec, encoders: str | os.PathLike[str] | None) -> list[Finding]:
    """What is absent, or belongs to something else, in the directory of a policy that was loaded."""
    entries = read_json(directory / CONFIG)
    features = _features(entries)
    found = read_processors(directory, features)
    steps = read_json(directory / PREPROCESSOR)["steps"]
    step: dict[str, Any] = next(each for each in steps if each.get("registry_name") == NORMALIZE)
    modes, file = step["config"].get("norm_map", {}), step.get("state_file")
    measured = {name.rpartition(".")[0] for name in read_tensors(directory / file)} if file else set()
    read = [key for key in features if found.renamed.get(key, key) in spec.observations or key == ACTION]
    doubts = []
    for key in read:
        mode = modes.get(features[key][0], "IDENTITY")
        normalised = found.action is not None if key == ACTION else key in found.normalizers
        if mode != "IDENTITY" and not normalised:
            told = f"there are no statistics of {key}, so it is not normalised ({mode} is configured)"
            doubts.append(Finding(PART, f"normaliser of {key}", told, Level.PROBLEM, f"{REPEAT} lerobot says nothing."))
        elif mode == "IDENTITY" and features[key][0] in ("STATE", "ACTION"):
            remedy = "Was the policy trained on the robot's own numbers? If not, its normaliser was lost."
            doubts.append(Finding(PART, f"normaliser of {key}", "none is configured", Level.WARNING, remedy))
    wanted, executed = entries.get("n_action_steps"), spec.chunk.stop - spec.chunk.start
    if isinstance(wanted, int) and wanted > executed:
        told = f"n_action_steps is {wanted}, and only {executed} predicted steps are left from the first executed on"
        remedy = f"Set it to {executed} in {CONFIG}: a robot that waits for more runs out of actions."
        doubts.append(Finding(PART, "chunk", told, Level.WARNING, remedy))
    return [*doubts, *_cameras(features, read, measured, step), *_tokenizer(directory, found, spec, encoders)]


def _features(entries: Mapping[str, Any]) -> Features:
    both = {**entries["input_features"], **entries["output_features"]}
    return {key: (str(one["type"]), tuple(one["shape"])) for key, one in both.items()}


def _cameras(features: Features, read: list[str], measured: set[str], step: Mapping[str, Any]) -> list[Finding]:
    """Names and sizes in the data that are not the policy's: lerobot passes over a picture that it does not know."""
    doubts = []
    known = [key for key, (kind, _) in features.items() if kind == "VISUAL"]
    foreign = sorted(key for key in measured if key.startswith(_IMAGES) and key not in known)
    unseen = [key for key in known if key in read and key not in measured]
    if foreign:
        told = f"the data had {', '.join(foreign)}, which the policy does not read"
        told += f"; it reads {', '.join(unseen)}, which the data had not" * bool(unseen)
        pairs = ", ".join(f'"{a}": "{b}"' for a, b in zip(foreign, unseen or known, strict=False))
        remedy = f"It may never have seen them. Train again with lerobot's rename_map, such as {{{pairs}}}."
        doubts.append(Finding(PART, "names of cameras", told, Level.WARNING, remedy))
    for key in known:
        shape = step["config"].get("features", {}).get(key, {}).get("shape")
        if shape and tuple(shape) != features[key][1]:
            told = f"{list(features[key][1])} in {CONFIG}, and {shape} where it was normalised"
            remedy = "Show the policy pictures of the size that it was trained with."
            doubts.append(Finding(PART, f"size of {key}", told, Level.WARNING, remedy))
    return doubts


def _tokenizer(
    directory: Path, found: Processors, spec: PolicySpec, encoders: str | os.PathLike[str] | None
) -> list[Finding]:
    """Of a policy that reads an instruction: whether the tokenizer is of its language model."""
    one, what, name = spec.observations.get(TOKENS), "tokenizer", str(found.tokenizer.get("tokenizer_name", "none"))
    if one is None or one.bounds is None:
        return []
    if (length := found.tokenizer.get("max_length", one.shape[0])) != one.shape[0]:
        told = f"makes {length!s:.20} tokens of an instruction; the policy reads {one.shape[0]}"
        remedy = f"Set its max_length to {one.shape[0]} in {PREPROCESSOR}."
        return [Finding(PART, what, told, Level.WARNING, remedy)]
    near = encoder_folders(encoders, directory)
    places = [place for each in near for place in (each / name, each / Path(name).name, each)]
    file = next((path for place in places if (path := find_tokenizer(place)) is not None), None)
    if file is None:
        return [Finding(PART, what, f"{name:.100}, which is not on this machine, and so was not tried", Level.NOTE)]
    known = int(np.max(one.bounds[1])) + 1
    try:
        size = Tokenizer(file, CheckpointError).size
    except CheckpointError as error:
        return [Finding(PART, what, str(error), Level.WARNING, "Copy it again from the model's repository.")]
    told, remedy = f"{file}: {size} tokens, of {known} that are known", "It is of another model: take the policy's own."
    return [Finding.judged(PART, what, told, size > known, remedy, Level.PROBLEM)]
