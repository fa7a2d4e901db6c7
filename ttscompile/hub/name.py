"""``hf://org/name[@revision][/path]``: which repository of the hub, which state of it, and what in it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from urllib.parse import unquote

from ..core.paths import HUB
from ..errors import HubError

_PART = r"[A-Za-z0-9][A-Za-z0-9._-]{0,95}"
_REPOSITORY = re.compile(f"{_PART}/{_PART}")
_REVISION = re.compile(r"[A-Za-z0-9][A-Za-z0-9._/-]{0,199}")
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.=+ -]{0,199}")
"""Of a file or a folder: nothing that a path, a pattern or a terminal would take for something else."""
EXPECTED = "expected hf://ORGANISATION/NAME, and perhaps @REVISION and /PATH after it"


@dataclass(frozen=True)
class HubName:
    """A name, read.

    Attributes:
        repository: ``org/name``.
        revision: a branch, a tag or a commit; None for the branch ``main``.
        inside: of a file or a folder in it; empty for all of it.
    """

    repository: str
    revision: str | None = None
    inside: str = ""

    @property
    def folder(self) -> str:
        """What the names of files in it begin with."""
        return f"{self.inside}/" if self.inside else ""

    def at(self, commit: str) -> str:
        """The same name, of one commit."""
        return f"{HUB}{self.repository}@{commit}" + (f"/{self.inside}" if self.inside else "")


def read_name(text: str) -> HubName:
    """Read a name.

    Args:
        text: begins with ``hf://``. A slash in a revision is written ``%2F``.

    Raises:
        HubError: it is none.
    """
    organisation, _, rest = text.removeprefix(HUB).partition("/")
    first, _, inside = rest.strip("/").partition("/")
    name, at, revision = first.partition("@")
    made = HubName(f"{organisation}/{name}", unquote(revision) if at else None, inside)
    require_repository(made.repository, text)
    if made.revision is not None and (_REVISION.fullmatch(made.revision) is None or ".." in made.revision):
        raise HubError(f"{text:.200}: @REVISION is a branch, a tag or a commit; {EXPECTED}.")
    if inside and not plain(inside):
        raise HubError(f"{text:.200}: /PATH is that of a file or a folder in the repository; {EXPECTED}.")
    return made


def require_repository(repository: str, told: str) -> None:
    """Raise HubError unless this is ``org/name``. It is not; the message begins with ``told``."""
    if _REPOSITORY.fullmatch(repository) is None or "--" in repository or ".." in repository:
        raise HubError(f"{told:.200}: this is no name of a repository; {EXPECTED}.")


def plain(path: str) -> bool:
    """Whether a path in a repository leads down alone, by names that are nothing else than names."""
    return all(_NAME.fullmatch(part) is not None and not part.endswith((".", " ")) for part in path.split("/"))
