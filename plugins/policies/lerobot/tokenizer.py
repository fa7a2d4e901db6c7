"""Which file makes an instruction the tokens of a policy of LeRobot."""

import os
from pathlib import Path

from ttscompile.core.tokenizer import find_tokenizer
from ttscompile.frontends.instruction import encoder_folders
from ttscompile.frontends.settings import read_json

from .config import CONFIG, MOST_LETTERS
from .groot_steps import ENCODE
from .processors import PREPROCESSOR, READ, TOKENIZE

_MODELS = ("vlm_model_name", "qwen_model_name", "vlm_base", "pretrained_name_or_path")
"""Entries of ``config.json`` that name a language model."""


def tokenizer_name(directory: Path) -> str:
    """The name of its tokenizer, or else of its language model, as it was saved; empty where it has neither."""
    entries, steps = read_json(directory / CONFIG), read_json(directory / PREPROCESSOR)["steps"]
    own = {TOKENIZE: "tokenizer_name", ENCODE: "model_name", READ: "processor_name"}
    told = [step.get("config", {}).get(own[name]) for step in steps if (name := step.get("registry_name")) in own]
    named = [name for name in (*told, *map(entries.get, _MODELS)) if isinstance(name, str)]
    return next(iter(named), "")[:MOST_LETTERS]


def tokenizer_file(directory: Path, encoders: str | os.PathLike[str] | None) -> Path | None:
    """The tokenizer of the policy's language model, if it is on this machine: ``tokenizer.json``, or CLIP's files.

    It is looked for in a folder of its name, and then where the user or the policy itself has one.
    """
    name, near = tokenizer_name(directory), encoder_folders(encoders, directory)
    named = [folder / one for folder in near for one in dict.fromkeys((name, Path(name).name)) if one]
    # What stands beside the policy under no name of its own may be anybody's.
    return next((path for place in (*named, *near[:-1]) if (path := find_tokenizer(place)) is not None), None)
