"""Which file makes an instruction the tokens of a policy of LeRobot."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ttscompile.core.tokenizer import find_tokenizer
from ttscompile.frontends.settings import read_json

from ..instruction import encoder_folders
from .config import CONFIG, MOST_LETTERS
from .groot_steps import read_groot_processors
from .processors import READ, Features, Processors, read_processors

_MODELS = ("vlm_model_name", "qwen_model_name", "vlm_base", "pretrained_name_or_path")
"""Entries of ``config.json`` that name a language model."""


def features_and_processors(directory: Path, entries: Mapping[str, Any]) -> tuple[Features, Processors]:
    """Of a policy of any type, with the entries of its ``config.json``."""
    both = {**entries["input_features"], **entries["output_features"]}
    features: Features = {key: (str(one["type"]), tuple(one["shape"])) for key, one in both.items()}
    kind = str(entries["type"])
    groot = kind == "groot"
    return features, read_groot_processors(directory, features) if groot else read_processors(directory, features, kind)


def tokenizer_name(entries: Mapping[str, Any], found: Processors) -> str:
    """The name of its tokenizer, or else of its language model, as it was saved; empty where it has neither."""
    told = found.tokenizer.get("tokenizer_name"), found.own.get(READ, {}).get("processor_name")
    named = [name for name in (*told, *map(entries.get, _MODELS)) if isinstance(name, str)]
    return next(iter(named), "")[:MOST_LETTERS]


def tokenizer_file(directory: Path, encoders: str | os.PathLike[str] | None) -> Path | None:
    """The tokenizer of the policy's language model, if it is on this machine: ``tokenizer.json``, or CLIP's files."""
    entries = read_json(directory / CONFIG)
    return file_of_name(tokenizer_name(entries, features_and_processors(directory, entries)[1]), directory, encoders)


def file_of_name(name: str, directory: Path, encoders: str | os.PathLike[str] | None) -> Path | None:
    """The tokenizer of this name: in a folder of its name, or else where the user or the policy itself has one."""
    near = encoder_folders(encoders, directory)
    named = [folder / one for folder in near for one in dict.fromkeys((name, Path(name).name)) if one]
    # What stands beside the policy under no name of its own may be anybody's.
    return next((path for place in (*named, *near[:-1]) if (path := find_tokenizer(place)) is not None), None)
