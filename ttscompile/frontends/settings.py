"""JSON that another program wrote, a checkpoint's configuration, each entry checked as it is taken."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from ..core.untrusted_json import parse_json
from ..errors import CheckpointError

MAX_BYTES = 4 * 2**20
"""Of a configuration; in use are some 10 KB."""


def read_json(path: Path) -> dict[str, Any]:
    """The object that a file holds."""
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file.")
    try:
        with path.open("rb") as file:
            data = parse_json(file.read(MAX_BYTES + 1), MAX_BYTES)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: cannot be read as JSON: {error!s:.300}. Copy the file again.") from error
    if not isinstance(data, dict):
        raise CheckpointError(f"{path}: holds a {type(data).__name__}; expected an object.")
    return data


@dataclass(frozen=True)
class Settings:
    """Entries by name; every method raises CheckpointError, which says what was found and what was expected.

    ``where`` begins every message, ``cfg.policy.`` or ``config.json: ``, and ``remedy``, a sentence, ends it.
    """

    values: Mapping[str, Any]
    where: str
    remedy: str = ""

    def number(self, name: str, default: int | None = None, most: int | None = None, least: int = 1) -> int:
        """A positive whole number, ``most`` at most; or with ``least`` 0 one that is not negative."""
        value = self.values.get(name, default)
        if type(value) is not int or value < least or (most is not None and value > most):
            limit = "" if most is None else f", {most} at most"
            raise self.refusal(name, f"a {'positive ' * least}whole number{limit}", default)
        return value

    def flag(self, name: str, default: bool) -> bool:
        """True or false."""
        value = self.values.get(name, default)
        if type(value) is not bool:
            raise self.refusal(name, "true or false")
        return value

    def choice(self, name: str, *allowed: str) -> str:
        """One of these texts, by default the first."""
        value = self.values.get(name, allowed[0])
        if value not in allowed:
            raise self.refusal(name, " or ".join(dict.fromkeys(allowed)))
        return str(value)

    def text(self, name: str, default: str, longest: int) -> str:
        """A name of so many letters at most."""
        value = self.values.get(name, default)
        if not isinstance(value, str) or not 0 < len(value) <= longest:
            raise self.refusal(name, "a name")
        return value

    def names(self, name: str) -> dict[str, str]:
        """Names by name; none where the entry is absent."""
        value = self.values.get(name, {})
        if not isinstance(value, dict) or not all(isinstance(item, str) for item in value.values()):
            raise self.refusal(name, "names by name")
        return value

    def size(self, name: str, default: list[int] | None, most: int | None = None) -> tuple[int, int] | None:
        """Height and width of an image, ``most`` pixels each at most; None for null."""
        value = self.values.get(name, default)
        if value is not None and (not is_shape(value, most) or len(value) != 2):
            limit = "" if most is None else f" of {most} pixels at most"
            raise self.refusal(name, f"[height, width]{limit} or null")
        return None if value is None else (value[0], value[1])

    def part(self, name: str) -> "Settings":
        """The entries of one of them."""
        value = self.values.get(name)
        if not isinstance(value, dict):
            raise self.refusal(name, "settings by name")
        return Settings(value, f"{self.where}{name}.", self.remedy)

    def require(self, **expected: Any) -> None:
        """Raise for an entry that is there, and says another variant than the one that is rebuilt."""
        for name, value in expected.items():
            if self.values.get(name, value) != value:
                raise self.refusal(name, f"{value}: another is not rebuilt here".lower())

    def refusal(self, name: str, expected: str, default: Any = None) -> CheckpointError:
        """The error for one entry."""
        return self.error(f"{name} is {self.values.get(name, default)!r:.80}; expected {expected}")

    def error(self, what: str) -> CheckpointError:
        """The error for anything else that is wrong with them."""
        return CheckpointError(f"{self.where}{what}.{self.remedy and ' '}{self.remedy}")


def is_shape(value: Any, most: int | None = None) -> TypeGuard[list[int]]:
    """Whether a value is a list of positive whole numbers, ``most`` at most."""
    whole = isinstance(value, list) and len(value) > 0 and all(type(n) is int and n >= 1 for n in value)
    return whole and (most is None or max(value) <= most)
