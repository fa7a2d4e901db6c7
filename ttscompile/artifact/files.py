"""Files on disk: hashes, and writes that either happened or did not."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path

from ..errors import ArtifactError
from .manifest import FileRecord

PARTIAL = ".partial"
"""Suffix of what is being written; never part of an artifact."""


def describe(path: Path) -> FileRecord:
    """Size and hash of a file. Raises OSError: it cannot be read."""
    with path.open("rb") as file:
        return FileRecord(sha256=hashlib.file_digest(file, "sha256").hexdigest(), bytes=path.stat().st_size)


def content_hash(content: bytes) -> str:
    """The 16 digits that go into a file's name."""
    return hashlib.sha256(content).hexdigest()[:16]


_AGAIN = "Copy the artifact again, or convert the checkpoint again."


@contextmanager
def opened(path: Path) -> Iterator[BufferedReader]:
    """A file to read from. Anything else is refused unread: a pipe or a device may never end.

    Raises:
        ArtifactError: missing, something else than a file, or it cannot be read, now or within the block.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # else a pipe waits for somebody who writes into it
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise ArtifactError(f"{path}: cannot be read: expected a file; found something else. {_AGAIN}")
        with os.fdopen(descriptor, "rb") as file:
            yield file
    except FileNotFoundError:
        raise ArtifactError(f"{path}: cannot be read: the file is missing; manifest.json lists it. {_AGAIN}") from None
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read: {error}. {_AGAIN}") from error


def read_file(path: Path, limit: int) -> bytes:
    """The content of a file of at most so many bytes; of a larger one no more is read, and the last byte is too many.

    Raises:
        ArtifactError: see ``opened``.
    """
    with opened(path) as file:
        return file.read(min(limit, os.fstat(file.fileno()).st_size) + 1)  # Python allocates what is asked for


def check_file(path: Path, record: FileRecord) -> None:
    """Raise unless the file is what its record says."""
    with opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size != record.bytes:
            kind = "truncated" if size < record.bytes else "longer than it was"
            raise ArtifactError(f"{path}: expected {record.bytes} bytes; found {size}: the file is {kind}. {_AGAIN}")
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != record.sha256:
        raise ArtifactError(
            f"{path}: expected sha256 {record.sha256[:12]}...; found {found[:12]}...: the file was changed since it was"
            f" written. {_AGAIN}"
        )


def write_synced(path: Path, content: bytes | Iterable[bytes | memoryview]) -> None:
    """Write a new file, whole or part by part, and wait until it is on disk."""
    with path.open("xb") as file:
        file.writelines([content] if isinstance(content, bytes) else content)
        file.flush()
        os.fsync(file.fileno())


def replace_file(path: Path, content: bytes) -> None:
    """Put a file in place at once: other processes see the old content or the new one, and so does a crash.

    Raises:
        OSError: it cannot be written; or something else than a file is there, such as ``/dev/null``.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EEXIST, "something else than a file is there", str(path))
    partial = beside(path)
    try:
        write_synced(partial, content)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    sync_directory(path.parent)


def beside(path: Path) -> Path:
    """A name in the same folder that nothing has, for what is not finished."""
    return path.with_name(f".{_short(path.name)}.{secrets.token_hex(4)}{PARTIAL}")


def _short(name: str) -> str:
    """The name, or of one so long that nothing more fits into 255 bytes its beginning and a hash of it."""
    content = os.fsencode(name)
    return name if len(content) <= 200 else f"{os.fsdecode(content[:160])}-{content_hash(content)}"


def sync_directory(path: Path) -> None:
    """Wait until the names in a folder are on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_folder(partial: Path, target: Path) -> None:
    """Put a finished folder in the place of another, which is removed: at every moment one of the two stands there.

    Linux exchanges two names at once. Where the file system cannot (NFS and some others), the old folder is renamed
    first; a crash between the two renames then leaves it beside ``target`` under a name that ends with ``.replaced``,
    from where ``new_folder`` puts it back.
    """
    if not target.exists():
        partial.replace(target)
    elif exchange(partial, target):
        shutil.rmtree(partial, ignore_errors=True)
    else:
        old = _replaced(target)
        target.replace(old)
        try:
            partial.replace(target)
        except BaseException:
            old.replace(target)
            raise
        shutil.rmtree(old, ignore_errors=True)
    sync_directory(target.parent)


_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def exchange(one: Path, other: Path) -> bool:
    """Exchange two names at once; False, and nothing changed, where the system or the file system cannot."""
    renameat2 = getattr(ctypes.CDLL(None), "renameat2", None)
    if renameat2 is None:
        return False
    names = os.fsencode(one), os.fsencode(other)
    return bool(renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0)


@contextmanager
def lock_folder(path: Path) -> Iterator[None]:
    """Keep other processes that ask from working in a folder; a crash releases it.

    Raises:
        BlockingIOError: another process has it, or has put another folder in its place.
        OSError: no permission, or a file system without locks.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not os.path.samestat(os.fstat(descriptor), path.stat()):  # it was replaced before it could be locked
            raise BlockingIOError
        yield
    finally:
        os.close(descriptor)


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """An empty folder beside ``target`` for what will take its place; gone after the block, if it is still there.

    Folders that killed processes left there are removed first. A live process holds a lock on its folder.
    """
    name = re.compile(rf"\.{re.escape(_short(target.name))}\.[0-9a-f]{{8}}{re.escape(PARTIAL)}")
    for path in [path for path in target.parent.iterdir() if name.fullmatch(path.name)]:
        with suppress(OSError), lock_folder(path):  # or somebody works in it, or removed it
            shutil.rmtree(path, ignore_errors=True)
    partial = beside(target)
    partial.mkdir()
    try:
        with lock_folder(partial):
            yield partial
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def recover(target: Path) -> None:
    """Put a folder back that a crash left renamed and not replaced; see ``replace_folder``."""
    old = _replaced(target)
    if old.is_dir() and not target.exists():
        old.replace(target)
    shutil.rmtree(old, ignore_errors=True)


def _replaced(target: Path) -> Path:
    return target.with_name(f".{_short(target.name)}.replaced")
