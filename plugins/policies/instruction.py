"""An instruction that is compiled in: its tokens, as the tokenizer of the checkpoint makes them."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ttscompile.core.spec import Instruction
from ttscompile.core.tokenizer import Tokenizer, find_tokenizer
from ttscompile.errors import CheckpointError
from ttscompile.frontends.settings import read_json

NAME_FOLDER = "Name the folder that has it: encoders= in Python, --encoders on the command line."
NO_TASK = "Or leave the task out: the policy then takes tokens as an observation."
_MOST_LETTERS = 200


def encoder_folders(encoders: str | os.PathLike[str] | None, directory: Path) -> list[Path]:
    """Where a language model's files are looked for: the folder that the user names, the checkpoint's, its parent."""
    return [*([] if encoders is None else [Path(encoders)]), directory, directory.resolve().parent]


def find_encoder(name: str, folders: Sequence[Path], kind: str = "clip") -> Path | None:
    """The local directory of an encoder: ``name``, or its last part, in one of ``folders``, or one of them itself.

    Args:
        name: as the policy's configuration says it: ``openai/clip-vit-base-patch16``, or a path of the machine that
            trained it, which may be this one.
        folders: where to look. They go first, so that a copy beside the policy is the one that is read.
        kind: how the ``model_type`` of its ``config.json`` begins.
    """
    given = Path(name)
    if max(map(len, given.parts), default=0) > _MOST_LETTERS:
        return None  # no file system has such a name, and some say so with an error
    names, places = [given.name], list(folders)
    if given.is_absolute():
        places.append(given)
    elif ".." not in given.parts:
        names.insert(0, name)
    for folder in places:
        for candidate in (*(folder / each for each in names if each), folder):
            path = candidate / "config.json"
            # The policy's own directory has one, too.
            if path.is_file() and str(read_json(path).get("model_type")).startswith(kind):
                return candidate
    return None


def language_model_folder(name: str, folders: list[Path], kind: str, what: str = "language model") -> Path:
    """The folder of a language model whose ``model_type`` begins with ``kind``."""
    found = find_encoder(name, folders, kind)
    if found is None:
        raise CheckpointError(
            f"the {what} {name!r} is not on this machine, and nothing is ever downloaded. Looked for its"
            f" config.json in {', '.join(dict.fromkeys(map(str, folders)))}. {NAME_FOLDER}"
        )
    return found


def task_tokens(
    text: str, name: str, folder: Path | None, most: int | None, vocabulary: int, remedy: str = NO_TASK
) -> list[int]:
    """The tokens of an instruction, without padding: nothing reads that.

    Args:
        folder: that has its ``tokenizer.json``; None if there is none.
        most: tokens that the policy reads; what is longer is cut, as lerobot does. None cuts nothing.
        vocabulary: tokens that the language model knows.
        remedy: where there is no tokenizer.
    """
    path = None if folder is None else find_tokenizer(folder)
    if path is None:
        where = "" if folder is None else f": {folder} has none"
        raise CheckpointError(
            f"the tokenizer {name!r:.200} is not on this machine{where}, and nothing is ever downloaded. Put its"
            f" tokenizer.json (or CLIP's vocab.json and merges.txt) beside config.json of the language model."
            f" {NAME_FOLDER} {remedy}".rstrip()
        )
    tokens = Tokenizer(path, CheckpointError)(text, most)
    if not tokens or max(tokens) >= vocabulary:
        found = f"token {max(tokens)}; the language model has {vocabulary}" if tokens else "no token at all"
        raise CheckpointError(f"{path}: it gives {found}. It belongs to another language model.")
    return tokens


def told_after(
    told: Instruction, name: str, folder: Path, vocabulary: int, image: int, places: int
) -> tuple[tuple[tuple[int, ...], ...], Instruction]:
    """The tokens of a prompt before each of its images; and how a task is told of which these are skipped.

    Args:
        image: the token that stands for one.
        places: of images that the prompt is written with.
    """
    tokens = task_tokens(told.line(""), name, folder, None, vocabulary, "")
    at = [i for i, token in enumerate(tokens) if token == image]
    if len(at) != places:
        found = f"{len(at)} tokens {image} (image_token_id) in a prompt of {places} images; expected one for each"
        raise CheckpointError(f"{folder}: its tokenizer makes {found}. It is of another model than its config.json.")
    between = tuple(tuple(tokens[start + 1 : end]) for start, end in zip([-1, *at], at, strict=False))
    return between, replace(told, skipped=places + sum(map(len, between)))
