"""What of a checkpoint of LeRobot goes wrong on a robot without an error: statistics, names of cameras, instruction."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ttscompile.core.finding import Finding, Level
from ttscompile.core.spec import PolicySpec
from ttscompile.core.tokenizer import Tokenizer
from ttscompile.errors import CheckpointError
from ttscompile.frontends.examined import PART, REPEAT, judged
from ttscompile.frontends.saved_weights import read_tensors
from ttscompile.frontends.settings import read_json

from .config import ACTION, CONFIG
from .policy import TOKENS
from .processors import NORMALIZE, PREPROCESSOR, Features, Processors
from .tokenizer import features_and_processors, file_of_name, tokenizer_name


def examine(path: Path, spec: PolicySpec, encoders: str | os.PathLike[str] | None) -> list[Finding]:
    """What lerobot saves beside a network: what is absent of it, or belongs to something else."""
    try:
        return _examined(path, spec, encoders)
    except CheckpointError as error:  # of what the policy does not read
        return [Finding(PART, "files", str(error), Level.NOTE)]


def _examined(directory: Path, spec: PolicySpec, encoders: str | os.PathLike[str] | None) -> list[Finding]:
    entries, steps = read_json(directory / CONFIG), read_json(directory / PREPROCESSOR)["steps"]
    features, found = features_and_processors(directory, entries)
    own = (one for one in steps if one.get("registry_name") == NORMALIZE)
    step: dict[str, Any] = {"config": {}} | next(own, {})
    doubts, action = [], {} if found.action is None else {ACTION: found.action}
    measured = _measured(directory, step)
    for key, (kind, _) in features.items():
        mode, name = step["config"].get("norm_map", {}).get(kind, "IDENTITY"), found.renamed.get(key, key)
        one = (action if key == ACTION else found.normalizers).get(key)
        if key != ACTION and name not in spec.observations:
            continue
        if one is not None:
            doubts.append(judged(name, one.first, one.second, one.mode == "MEAN_STD", one.still))
        elif mode == "IDENTITY" and kind not in ("STATE", "ACTION"):
            continue  # as SmolVLA and its like see pictures
        elif mode == "IDENTITY" and key in measured:
            told = "there are statistics, and IDENTITY is configured, so it is not normalised"
            remedy = f"Was it trained so? If not, correct norm_map in {PREPROCESSOR}."
            doubts.append(Finding(PART, f"normaliser of {name}", told, Level.WARNING, remedy))
        else:
            told = f"there are no statistics of {key}, so it is not normalised ({mode} is configured)"
            level = Level.WARNING if mode == "IDENTITY" else Level.PROBLEM
            remedy = f"Was it trained so? lerobot says nothing. {REPEAT}"
            doubts.append(Finding(PART, f"normaliser of {name}", told, level, remedy))
    doubts += _embodiment(steps)
    wanted, executed = entries.get("n_action_steps"), spec.chunk.executes
    if isinstance(wanted, int) and wanted > executed:
        told = f"n_action_steps is {wanted}, and only {executed} predicted steps are left from the first executed on"
        remedy = f"Set it to {executed} in {CONFIG}: a robot that waits for more runs out of actions."
        doubts.append(Finding(PART, "chunk", told, Level.WARNING, remedy))
    name = tokenizer_name(entries, found)
    return [*doubts, *_cameras(features, step, measured), *_tokenizer(directory, name, found, spec, encoders)]


def _embodiment(steps: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Of GR00T: an embodiment that is in no table."""
    for config in (step.get("config", {}) for step in steps):
        tag, known = config.get("embodiment_tag"), config.get("embodiment_mapping")
        if isinstance(known, dict) and tag not in known:
            told = f"embodiment_tag {tag!r:.80} is none of embodiment_mapping, so the weights of number 0 are taken"
            remedy = f"So does lerobot, in training too. Was it trained as one of {', '.join(map(str, known))[:300]}?"
            return [Finding(PART, "embodiment", told, Level.WARNING, remedy)]
    return []


def _measured(directory: Path, step: Mapping[str, Any]) -> set[str]:
    """Of what in the data there are statistics."""
    file = step.get("state_file")
    return {name.rpartition(".")[0] for name in read_tensors(directory / file)} if file else set()


def _cameras(features: Features, step: Mapping[str, Any], measured: set[str]) -> list[Finding]:
    """Names and sizes in the data that are not the policy's: lerobot passes over a picture that it does not know."""
    doubts, known = [], [key for key, (kind, _) in features.items() if kind == "VISUAL"]
    foreign = sorted(key for key in measured if key.startswith("observation.images.") and key not in known)
    if foreign:
        told = (
            f"the data had {', '.join(foreign)}, which the policy does not read; it reads {', '.join(known) or 'none'}"
        )
        pairs = ", ".join(f'"{a}": "{b}"' for a, b in zip(foreign, known, strict=False))
        remedy = f"It may never have seen them. Train again with lerobot's rename_map, such as {{{pairs}}}."
        doubts.append(Finding(PART, "names of cameras", told, Level.WARNING, remedy))
    of_data = {key: one for key, one in step["config"].get("features", {}).items() if isinstance(one, dict)}
    for key in known:
        shape = of_data.get(key, {}).get("shape")
        if not isinstance(shape, list) or tuple(shape) == features[key][1]:
            continue
        told = f"{list(features[key][1])} in {CONFIG}, and {shape} in the data"
        doubts.append(Finding(PART, f"size of {key}", told, Level.WARNING, "Show the policy pictures of that size."))
    return doubts


def _tokenizer(
    directory: Path, name: str, found: Processors, spec: PolicySpec, encoders: str | os.PathLike[str] | None
) -> list[Finding]:
    """Of a policy that reads an instruction: whether the tokenizer is of its language model."""
    one = spec.observations.get(TOKENS)
    if one is None or one.bounds is None:
        return []
    file = file_of_name(name, directory, encoders)
    level, told, remedy = Level.NOTE, f"{name or 'none':.100}, which is not on this machine, and so was not tried", ""
    if (length := found.tokenizer.get("max_length", one.shape[0])) != one.shape[0]:
        level, told = Level.WARNING, f"makes {length!s:.20} tokens of an instruction; {one.shape[0]} are read"
        remedy = f"Correct max_length in {PREPROCESSOR}."
    elif file is not None:
        try:
            size, known = Tokenizer(file, CheckpointError).size, round(one.bounds[1][0]) + 1  # type: ignore[index]
            level, told = Level.PROBLEM if size > known else Level.OK, f"{file}: {size} tokens; {known} are known"
            remedy = "It is of another model: take the policy's own." * (size > known)
        except CheckpointError as error:
            level, told, remedy = Level.WARNING, str(error), "Copy it again from the model's repository."
    return [Finding(PART, "tokenizer", told, level, remedy)]
