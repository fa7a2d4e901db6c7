"""An artifact's directory while it is read: what was checked is what is used, whatever takes its place meanwhile.

The directory is held by a descriptor, and files are named through that, ``/proc/self/fd/N/NAME``: the directory stays
the one that was opened, wherever its name leads by then. (onnxruntime opens models and weights by name; arrays given to
it would be held twice.) What happens to the files inside shows in their stamps, which are compared before and after.
A file that was moved away and came back, or was written in place, has another time of change.

Where there is no such ``/proc``, as on macOS, files are named by the path as it was given, and the directory has a
stamp as well: exchanged and exchanged back, it has another time of change, too.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import ArtifactChangedError, ArtifactError

HELD = "/proc/self/fd"
"""Where a process finds what it holds open, by the number of the descriptor."""

Stamp = tuple[int, ...] | None
"""What changes when a file is written, replaced, or moved away and back; None where there is none."""


class Folder:
    """A directory, held open as long as this object lives.

    Args:
        path: of the directory.
        shown: what messages name; the zip file that was unpacked there.

    Attributes:
        files: the directory to read from.

    Raises:
        OSError: no directory, or one that may not be read.
    """

    def __init__(self, path: Path, shown: Path) -> None:
        self._path, self._shown = path, shown
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        weakref.finalize(self, os.close, descriptor)
        self._held = os.fstat(descriptor)
        self.files = Path(HELD, str(descriptor))
        if not _same(self.files, self._held):
            self.files = path

    @contextmanager
    def unchanged(self, names: Iterable[str]) -> Iterator[Mapping[str, Stamp]]:
        """Within the block these files are read, and after it they are known to have been the same all the while.

        Gives their stamps. Messages of errors name what ``shown`` says.

        Raises:
            ArtifactChangedError: a file was changed or replaced; or what was done in the block failed, and the
                directory was moved, or is no longer the one at its path. (onnxruntime holds the real paths of files
                against each other, so moving the directory may be an error to it.)
        """
        directory, before = _stamp(self.files), {name: _stamp(self.files / name) for name in names}
        try:
            yield before
        except Exception as error:
            moved = _stamp(self.files) != directory or not _same(self._path, self._held)
            if (others := self._others(before)) or moved:
                raise self.changed(others) from error
            told = str(error).replace(str(self.files), str(self._shown)).replace(str(self._path), str(self._shown))
            if isinstance(error, ArtifactError) and told != str(error):
                raise type(error)(told) from error
            raise
        others = self._others(before)
        if others or (self.files == self._path and _stamp(self.files) != directory):
            raise self.changed(others)

    def _others(self, before: Mapping[str, Stamp]) -> list[str]:
        """Those that have another stamp by now."""
        return [name for name, stamp in before.items() if stamp != _stamp(self.files / name)]

    def changed(self, names: Sequence[str] = ()) -> ArtifactChangedError:
        """The error of an artifact that is no longer what was read of it; ``names`` are of files that show it."""
        which = f" ({', '.join(names[:3])}{', ..' * (len(names) > 3)})" if names else ""
        if self._shown != self._path:
            told = f"what it was unpacked to, {self._path}, was changed or removed{which}. Load it again."
            return ArtifactChangedError(f"{self._shown}: {told}")
        return ArtifactChangedError(
            f"{self._path}: the artifact was replaced or changed while it was being read, or since it was loaded"
            f"{which}. Load it again when nothing writes there any more."
        )


def _stamp(path: Path) -> Stamp:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def _same(path: Path, held: os.stat_result) -> bool:
    """Whether a path leads to a directory that is held open."""
    with suppress(OSError):
        return os.path.samestat(path.stat(), held)
    return False
