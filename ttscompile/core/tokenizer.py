"""Text to tokens, with the small ``tokenizers`` wheel; imported when it is used."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .coercion import Errors
from .spec import Instruction

TASK = "task"
"""The key of an instruction's text, as LeRobot has it."""

FILE = "tokenizer.json"
_MOST_BYTES = 64 * 2**20
"""Of its file; PaliGemma's has 18 MB."""


class Tokenizer:
    """What ``tokenizer.json`` describes.

    Args:
        path: of the file, or of the folder that has it.
        error: class of the errors.

    Raises:
        TtscompileError: of the class ``error``: no such file, one that is too large or damaged, or no ``tokenizers``.
    """

    def __init__(self, path: str | os.PathLike[str], error: Errors) -> None:
        own = Path(path)
        self._path, self._error = own / FILE if own.is_dir() else own, error
        self._tokenizer: Any = self._read()

    def _read(self) -> Any:
        path = self._path
        if not path.is_file() or path.stat().st_size > _MOST_BYTES:
            what = "no such file" if not path.is_file() else f"has more than {_MOST_BYTES:,} bytes"
            raise self._error(f"{path}: {what}; expected the {FILE} of the policy's language model.")
        try:
            import tokenizers
        except ModuleNotFoundError as missing:
            remedy = "Install 'ttscompile[tokens]', or give tokens in place of text"
            raise self._error(
                f"{path}: text needs the package tokenizers, which is not installed. {remedy}."
            ) from missing
        try:
            made = tokenizers.Tokenizer.from_file(str(path))
        except Exception as damaged:  # of damaged files the package raises plain Exception
            raise self._error(f"{path}: no tokenizer that can be read: {damaged!s:.200}. Copy it again.") from damaged
        made.no_padding()
        made.no_truncation()
        return made

    @property
    def size(self) -> int:
        """How many tokens there are, added ones counted."""
        return int(self._tokenizer.get_vocab_size())

    def __call__(self, text: str) -> list[int]:
        """The tokens of a text, all of them, with those that the tokenizer adds."""
        try:
            return list(self._tokenizer.encode(text).ids)
        except Exception as refused:
            raise self._error(f"{self._path}: {text!r:.100} has no tokens: {refused!s:.200}.") from refused

    def of_task(self, text: str, told: Instruction, length: int) -> list[int]:
        """The tokens that a policy observes of a task; too many are refused where words after the text would be cut."""
        tokens = self(told.line(text))[told.skipped :]
        if told.around and len(tokens) > length:
            found = f"{len(tokens)} tokens, and the policy reads {length}"
            raise self._error(f"the task {text!r:.100} has {found}. Use fewer words, or compile it in: convert --task.")
        return tokens


def padded(tokens: Sequence[Sequence[int]], length: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Tokens of n texts as ``[n, length]``, with zeros after them, and which count; cut at the end, as lerobot does."""
    rows, mask = np.zeros((len(tokens), length), np.int64), np.zeros((len(tokens), length), np.bool_)
    for i, made in enumerate(each[:length] for each in tokens):
        rows[i, : len(made)], mask[i, : len(made)] = made, True
    return rows, mask


def find_tokenizer(folder: Path) -> Path | None:
    """The file in a folder, if it has one."""
    path = folder / FILE
    return path if path.is_file() else None
