"""One thing that was looked at: by the doctor, and by ``convert``. Standard library alone."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Level(enum.Enum):
    """How much it matters."""

    OK = "ok"
    NOTE = "note"  # worth knowing
    WARNING = "warning"  # slower, or less certain, than it could be
    PROBLEM = "problem"  # stops artifacts from running, or makes what they answer mean nothing


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at; every warning and problem has a remedy."""

    part: str
    what: str
    found: str
    level: Level = Level.OK
    remedy: str = ""

    def __post_init__(self) -> None:
        assert self.remedy or self.level in (Level.OK, Level.NOTE), f"{self.what}: no remedy"

    @classmethod
    def judged(
        cls, part: str, what: str, found: str, wrong: bool, remedy: str, level: Level = Level.WARNING
    ) -> Finding:
        """Of this level and with this remedy if it is wrong, else ``OK`` and without."""
        return cls(part, what, found, level, remedy) if wrong else cls(part, what, found)

    @property
    def told(self) -> str:
        """In a line, for where there is no table."""
        return f"{self.what}: {self.found.rstrip('.')}. {self.remedy}"
