"""Text to tokens, with the small ``tokenizers`` wheel; imported when it is used."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .coercion import Errors
from .rules import OMITTED

TASK = "task"
"""The key of an instruction's text, as LeRobot has it."""

FILE = "tokenizer.json"

_VOCABULARY, _MERGES = "vocab.json", "merges.txt"
_MOST_BYTES = 64 * 2**20
"""Of a file; PaliGemma's has 18 MB."""

_WORDS = r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"
"""What CLIP takes for a word, as transformers has it; its ``vocab.json`` does not say so."""

IN_WORDS = "{state}"
"""Stands in what is after a text for the words of the state."""
_PARTS = np.linspace(-1, 1, 257)[:-1]
"""Where the 256 parts of -1..1 begin that openpi and LeRobot number."""


@dataclass(frozen=True)
class StateInWords:
    """How a state stands in an instruction: of each number, normalised, which of 256 equal parts of -1..1 it is in.

    Attributes:
        key: of the observation, float32 ``[B, D]``, as the robot measures it.
        first: ``[D]``, what is subtracted from it.
        width: ``[D]``, what the rest is divided by; not zero.
        ranged: whether that is the width of a range, which becomes -1..1, and not a deviation.
        double: whether that is computed in float64, as openpi does; else in float32, as LeRobot does.
    """

    key: str
    first: tuple[float, ...]
    width: tuple[float, ...]
    ranged: bool
    double: bool = field(default=False, metadata=OMITTED)

    def __call__(self, state: npt.NDArray[np.float32]) -> str:
        """The words of one state ``[D]``; below -1 it is -1, and beyond 1 the last part."""
        first, width = np.array([self.first, self.width], np.float64 if self.double else np.float32)
        # In the order in which both compute it: an end of a range is an edge of a part, and rounding would move it.
        inside = 2 * (state - first) / width - 1 if self.ranged else (state - first) / width
        return " ".join(map(str, np.digitize(inside, _PARTS) - 1))


@dataclass(frozen=True)
class Instruction:
    """How the text of a task becomes two observations, where somebody has the tokenizer.

    Attributes:
        tokens: key of the tokens, int64 ``[B, L]``, padded at the end.
        mask: key of what says which of them count, bool ``[B, L]``.
        new_line: whether the text ends with a new line before it is tokenized.
        before: lines before the text, of a policy that has some. The text is then stripped, unless it is in a line with
            others.
        skipped: the first so many tokens of all together are no part of the observation.
        around: what is directly before and after the text, of a policy that has such.
        plain: whether the text is in lower case, and of its signs only letters, digits, spaces and ``_`` are left.
        otherwise: stands for an empty text.
        end: of every text, which is added where a text has another.
        never: what no text may hold, since the original takes it for something else than text.
        after: lines after the text, of a policy that has some.
        spaced: whether the text is stripped, and ``_`` and the ends of its lines become blanks.
        state: what of the robot's state is after the text, where ``around`` has ``{state}``; None for nothing.
    """

    tokens: str
    mask: str
    new_line: bool
    before: tuple[str, ...] = field(default=(), metadata=OMITTED)
    skipped: int = field(default=0, metadata=OMITTED)
    around: tuple[str, ...] = field(default=(), metadata=OMITTED)
    plain: bool = field(default=False, metadata=OMITTED)
    otherwise: str = field(default="", metadata=OMITTED)
    end: str = field(default="", metadata=OMITTED)
    never: tuple[str, ...] = field(default=(), metadata=OMITTED)
    after: tuple[str, ...] = field(default=(), metadata=OMITTED)
    spaced: bool = field(default=False, metadata=OMITTED)
    state: StateInWords | None = field(default=None, metadata=OMITTED)

    def line(self, text: str, state: str = "") -> str:
        """What is tokenized, of a text and the words of a state."""
        text = text or self.otherwise
        if self.plain:
            text = "".join(c for c in text.lower() if c.isalnum() or c.isspace() or c == "_") or self.otherwise
        text = text.removesuffix(self.end) + self.end
        if self.spaced:
            text = text.strip().replace("_", " ").replace("\n", " ")
        if self.around:
            text = text.join(part.replace(IN_WORDS, state) for part in self.around)
        elif self.before:
            text = text.strip()
        text = "\n".join([*self.before, text, *self.after])
        return f"{text}\n" if self.new_line and not text.endswith("\n") else text


class Tokenizer:
    """What ``tokenizer.json`` describes, or CLIP's tokenizer of ``vocab.json`` and ``merges.txt``; in a folder, too.

    Raises:
        TtscompileError: of the class ``error``: no such file, one that is too large or damaged, or no ``tokenizers``.
    """

    def __init__(self, path: str | os.PathLike[str], error: Errors) -> None:
        own = Path(path)
        self._path, self._error = (find_tokenizer(own) or own / FILE) if own.is_dir() else own, error
        self._tokenizer: Any = self._read()

    def _read(self) -> Any:
        path = self._path
        clip = path.name == _VOCABULARY
        for file in (path, path.with_name(_MERGES)) if clip else (path,):
            if not file.is_file() or file.stat().st_size > _MOST_BYTES:
                what = "no such file" if not file.is_file() else f"has more than {_MOST_BYTES:,} bytes"
                raise self._error(f"{file}: {what}; expected the {FILE} of the policy's language model.")
        try:
            import tokenizers
        except ModuleNotFoundError as missing:
            remedy = "which is not installed. Install 'ttscompile[tokens]', or give tokens in place of text"
            raise self._error(f"{path}: text needs the package tokenizers, {remedy}.") from missing
        try:
            made = _clip(path) if clip else tokenizers.Tokenizer.from_file(str(path))
        except Exception as damaged:  # of damaged files the package raises plain Exception
            raise self._error(f"{path}: no tokenizer that can be read: {damaged!s:.200}. Copy it again.") from damaged
        made.no_padding()
        return made

    @property
    def size(self) -> int:
        """One more than its largest token, added ones counted: what a model has to know."""
        return max(self._tokenizer.get_vocab().values(), default=-1) + 1

    @property
    def json(self) -> bytes:
        """What ``tokenizer.json`` says of it: the file that was read, or of CLIP's two files what they make."""
        return self._path.read_bytes() if self._path.name != _VOCABULARY else self._tokenizer.to_str().encode()

    def with_words(self, words: Sequence[str]) -> list[int]:
        """The token of each of these words; those that are none yet become one, as transformers adds them."""
        known = self._tokenizer
        missing = dict.fromkeys(word for word in words if known.token_to_id(word) is None)
        known.add_special_tokens(list(missing))  # at once: each time it reads again all that it has
        return [known.token_to_id(word) for word in words]

    def __call__(self, text: str, most: int | None = None) -> list[int]:
        """The tokens of a text, with those that the tokenizer adds; ``most`` of them, cut before an added end."""
        try:
            self._tokenizer.no_truncation() if most is None else self._tokenizer.enable_truncation(most)
            return list(self._tokenizer.encode(text).ids)
        except Exception as refused:
            raise self._error(f"{self._path}: {text!r:.100} has no tokens: {refused!s:.200}.") from refused

    def of_task(self, text: str, told: Instruction, length: int, state: str = "") -> list[int]:
        """The tokens that a policy observes of a task, with the words of the state where the instruction has them.

        Too many are refused where words after the text would be cut; of pi0.5, whose state is after it, they are cut,
        as LeRobot cuts them in training.
        """
        if held := [word for word in told.never if word in text]:
            raise self._error(f"the task {text!r:.100} holds {held[0]}, no text to this policy. Leave it out.")
        whole = told.around and told.state is None
        most = None if whole else told.skipped + length
        tokens = self(told.line(text, state), most)[told.skipped :]
        if whole and len(tokens) > length:
            found = f"{len(tokens)} tokens, and the policy reads {length}"
            raise self._error(f"the task {text!r:.100} has {found}. Use fewer words, or compile it in: convert --task.")
        return tokens


ReadTokenizer: TypeAlias = Callable[[Errors], Tokenizer]
"""Reads a tokenizer when it is called, with errors of this class: whoever has tokens needs none."""


def _clip(vocabulary: Path) -> Any:
    """CLIP's tokenizer of the two files that it was published with."""
    from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, processors

    begin, end = "<|startoftext|>", "<|endoftext|>"
    merges = str(vocabulary.with_name(_MERGES))
    made = Tokenizer(models.BPE.from_file(str(vocabulary), merges, unk_token=end, end_of_word_suffix="</w>"))
    made.normalizer = normalizers.Sequence(
        [normalizers.NFC(), normalizers.Replace(Regex(r"\s+"), " "), normalizers.Lowercase()]
    )
    words = pre_tokenizers.Split(Regex(_WORDS), "removed", invert=True)
    made.pre_tokenizer = pre_tokenizers.Sequence([words, pre_tokenizers.ByteLevel(add_prefix_space=False)])
    around = (end, made.token_to_id(end)), (begin, made.token_to_id(begin))
    made.post_processor = processors.RobertaProcessing(*around, trim_offsets=False, add_prefix_space=False)  # type: ignore[arg-type]
    return made


def padded(tokens: Sequence[Sequence[int]], length: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Tokens of n texts, ``length`` at most, as ``[n, length]`` with zeros after them, and which count."""
    rows, mask = np.zeros((len(tokens), length), np.int64), np.zeros((len(tokens), length), np.bool_)
    for i, made in enumerate(tokens):
        rows[i, : len(made)], mask[i, : len(made)] = made, True
    return rows, mask


def find_tokenizer(folder: Path) -> Path | None:
    """The file in a folder, if it has one."""
    whole, clip = folder / FILE, folder / _VOCABULARY
    if whole.is_file():
        return whole
    return clip if clip.is_file() and clip.with_name(_MERGES).is_file() else None
