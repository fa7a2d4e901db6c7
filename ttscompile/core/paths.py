"""The one door for paths that somebody gives: files and directories come in, and nothing that may be read for ever."""

import os
import stat
from pathlib import Path

from ..errors import TtscompileError

HUB = "hf://"
"""How a name begins that is no path: that of a repository of the Hugging Face hub. ``ttscompile.hub`` reads it."""

_KINDS = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def on_hub(path: str | os.PathLike[str]) -> bool:
    """Whether this names a repository of the hub, in place of a path."""
    return isinstance(path, str) and path.startswith(HUB)


def require_path(path: str | os.PathLike[str], error: type[TtscompileError], give: str) -> None:
    """Raise unless a path leads to a file or a directory, before anything of it is opened."""
    require_free_or_path(path, error, give)
    if not Path(path).exists():
        link = " (it is a link to nothing)" if Path(path).is_symlink() else ""
        raise error(f"{os.fspath(path)}: does not exist{link}. {give}")


def require_free_or_path(path: str | os.PathLike[str], error: type[TtscompileError], give: str) -> None:
    """The same for a path that is written: there may be nothing. Raises TtscompileError: see ``require_path``."""
    name = os.fspath(path)
    try:
        mode = Path(path).stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    except (OSError, ValueError) as problem:  # a name of more than 255 bytes, one with a zero byte, no permission
        why = getattr(problem, "strerror", None) or problem
        shown = name if len(name) <= 300 else f"{name[:100]}...{name[-100:]}"
        raise error(f"{shown}: cannot be looked up: {why}. {give}") from problem
    for is_kind, what in _KINDS:
        if is_kind(mode):
            raise error(f"{name}: expected a file or a directory; found {what}. {give}")
