"""Zip files of strangers: a directory of at most so many entries, and bytes, before Python makes objects of them."""

import zipfile
from typing import IO, Any

MAX_ENTRIES = 10_000
MAX_DIRECTORY = 4 * 2**20


class _Limited:
    """A file of which no more is read at once, as long as there is a limit."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.limit: int | None = MAX_DIRECTORY

    def read(self, size: int = -1) -> bytes:
        if self.limit is None:
            return self._file.read(size)
        if len(content := self._file.read(self.limit + 1 if size < 0 else min(size, self.limit + 1))) > self.limit:
            raise zipfile.BadZipFile(f"expected a directory of at most {self.limit:,} bytes; found a longer one")
        return content

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def open_zip(file: IO[bytes]) -> zipfile.ZipFile:
    """An archive to read from, or BadZipFile; ``zipfile`` reads the whole directory, at once, when it opens one."""
    limited = _Limited(file)
    archive = zipfile.ZipFile(limited)  # all that it asks of a file
    if (found := len(archive.filelist)) > MAX_ENTRIES:
        raise zipfile.BadZipFile(f"expected at most {MAX_ENTRIES:,} entries; found {found:,}")
    limited.limit = None
    return archive
