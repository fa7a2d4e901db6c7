"""What must not happen while a file is refused: nothing executed, nothing written outside, no more memory than allowed.

Python's audit hooks tell of every file that is opened, every process and every library that is loaded. A hook cannot be
taken away again, so this belongs in a process of its own.
"""

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MORE_BYTES = 2**30
"""Address space that a case may take beside what the process had when it began."""

_NEVER = frozenset(
    {
        "os.system",
        "os.exec",
        "os.fork",
        "os.posix_spawn",
        "os.spawn",
        "subprocess.Popen",
        "pty.spawn",
        "ctypes.dlopen",
        "socket.connect",
        "socket.bind",
        "pickle.find_class",
        "builtins.breakpoint",
        "code.__new__",
        "webbrowser.open",
    }
)
_PATHS = {
    "os.mkdir": ((0, 2),),
    "os.remove": ((0, 1),),
    "os.rmdir": ((0, 1),),
    "os.rename": ((0, 2), (1, 3)),
    "os.link": ((1, 3),),
    "os.symlink": ((1, 2),),
    "os.truncate": ((0, None),),
    "os.chmod": ((0, 2),),
    "os.chown": ((0, 3),),
}
"""Event -> positions of each path among its arguments, and of the folder that it is relative to."""
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


class Violation(BaseException):
    """Something happened that must not; not an ``Exception``, so that no loader takes it for a damaged file."""


class Guard:
    """Watches this process from now on.

    Args:
        inside: the only folder where anything may be written.
    """

    def __init__(self, inside: Path) -> None:
        self._inside = os.path.realpath(inside)
        self._active = False
        self.violations: list[str] = []
        sys.addaudithook(self._hook)

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Watch, and allow so much memory, within the block.

        Raises:
            Violation: something happened that must not.
        """
        self.violations.clear()
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (address_space() + MORE_BYTES, hard))
        self._active = True
        try:
            yield
        finally:
            self._active = False
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        if self.violations:
            raise Violation("; ".join(self.violations[:3]))

    def _hook(self, event: str, args: tuple[Any, ...]) -> None:
        if not self._active:
            return
        if event in _NEVER:
            self._tell(f"{event}{args!r}")
        elif event == "open":
            path, mode, flags = args
            writes = (flags or 0) & _WRITING or (isinstance(mode, str) and set(mode) & set("wax+"))
            if writes and not isinstance(path, int):
                self._require_inside(event, path)
        elif event in _PATHS:
            for position, folder in _PATHS[event]:
                self._require_inside(event, args[position], -1 if folder is None else args[folder])
        elif event == "exec" and getattr(args[0], "co_filename", "<string>") == "<string>":
            self._tell(f"exec of a string: {getattr(args[0], 'co_names', args[0])!r}")

    def _require_inside(self, event: str, path: Any, folder: int = -1) -> None:
        if isinstance(path, int):
            return
        start = Path.cwd() if folder == -1 else Path(f"/proc/self/fd/{folder}").readlink()
        real = os.path.realpath(start / os.fsdecode(path))
        if real != "/dev/null" and os.path.commonpath((real, self._inside)) != self._inside:
            self._tell(f"{event} of {real}")

    def _tell(self, what: str) -> None:
        self.violations.append(what[:300])
        raise Violation(what[:300])


def address_space() -> int:
    """Bytes of address space that this process has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()
