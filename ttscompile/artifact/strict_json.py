"""JSON that is read strictly: every error names the path in the document, what was expected and what was found."""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple, NoReturn

from ..core.untrusted_json import MAX_VALUES, parse_json
from ..errors import ArtifactError

MAX_BYTES = 64 * 2**20
REMEDY = "The file was changed or damaged; copy the artifact again, or convert the checkpoint again."


class Value(NamedTuple):
    """What ``json.loads`` gave, and where it stands, for messages: ``manifest.json: spec.sampler.clip``."""

    data: Any
    path: str

    def fail(self, expected: str) -> NoReturn:
        """Raise for this value."""
        raise ArtifactError(f"{self.path}: expected {expected}; found {_shorten(self.data)}. {REMEDY}")

    def keys(self, *names: str) -> dict[str, Value]:
        """The members of an object that has exactly these keys."""
        members = self.members()
        missing = [key for key in names if key not in members]
        unknown = [key for key in members if key not in names]
        if missing or unknown:
            found = f"missing: {missing}, unknown: {_shorten(unknown)}"
            self.fail(f"an object with the keys {', '.join(names)} ({found})")
        return members

    def members(self) -> dict[str, Value]:
        """The members of an object with any keys, in order."""
        if not isinstance(self.data, dict):
            self.fail("an object")
        return {key: Value(item, f"{self.path}.{key:.80}") for key, item in self.data.items()}

    def items(self, most: int | None = None) -> list[Value]:
        """The items of a list."""
        if not isinstance(self.data, list) or (most is not None and len(self.data) > most):
            self.fail("a list" if most is None else f"a list of at most {most} items")
        return [Value(item, f"{self.path}[{i}]") for i, item in enumerate(self.data)]

    def text(self, *allowed: str) -> str:
        """A string; one of ``allowed`` if any are given."""
        if not isinstance(self.data, str) or (allowed and self.data not in allowed):
            self.fail(f"one of {', '.join(map(repr, allowed))}" if allowed else "a string")
        return self.data

    def boolean(self) -> bool:
        """True or false."""
        if not isinstance(self.data, bool):
            self.fail("true or false")
        return self.data

    def integer(self, least: int | None = 0, most: int = 2**63 - 1) -> int:
        """An integer, by default not negative; a boolean is none."""
        if not isinstance(self.data, int) or isinstance(self.data, bool):
            self.fail("an integer")
        if not (-(2**63) if least is None else least) <= self.data <= most:
            self.fail("a 64-bit integer" if least is None else f"a 64-bit integer of at least {least}, at most {most}")
        return self.data

    def number(self) -> float:
        """A finite number."""
        if not isinstance(self.data, int | float) or isinstance(self.data, bool):
            self.fail("a number")
        try:
            number = float(self.data)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            self.fail("a finite number")
        return number


def parse(content: bytes, where: str, limit: int = MAX_BYTES, values: int = MAX_VALUES) -> Value:
    """Parse a file of an artifact of so many bytes and values at most; see ``parse_json`` for what is refused."""
    try:
        return Value(parse_json(content, limit, values=values, shown=True), where)
    except ValueError as error:
        raise ArtifactError(f"{where}: expected a JSON document; {error}. {REMEDY}") from None


def dump(data: object) -> bytes:
    """A document for people: one space of indentation, order of the keys kept, a newline at the end."""
    return (json.dumps(data, indent=1, allow_nan=False) + "\n").encode("ascii")


def dump_compact(data: object) -> bytes:
    """A document for hashing: no white space, order of the keys kept."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).encode("ascii")


def _shorten(data: object) -> str:
    text = ascii(data)
    return text if len(text) <= 80 else f"{text[:77]}..."
