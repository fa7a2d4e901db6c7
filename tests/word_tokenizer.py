"""A tokenizer with a token a word, as its file has it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def write_tokenizer(folder: Path, words: Mapping[str, int]) -> Path:
    """The folder, with a ``tokenizer.json`` that splits at spaces; a line's end is a word, and ``?`` an unknown one."""
    folder.mkdir()
    model = {"type": "WordLevel", "vocab": dict(words), "unk_token": "?"}
    split: dict[str, Any] = {"type": "Split", "pattern": {"String": " "}, "behavior": "Removed", "invert": False}
    lines = {"type": "Split", "pattern": {"String": "\n"}, "behavior": "Isolated", "invert": False}
    both = {"type": "Sequence", "pretokenizers": [split, lines]}
    written = {"version": "1.0", "added_tokens": [], "pre_tokenizer": both, "model": model}
    (folder / "tokenizer.json").write_text(json.dumps(written))
    return folder
