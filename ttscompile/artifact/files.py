"""Files on disk: hashes, and writes that either happened or did not."""

from __future__ import annotations

import hashlib
import os
import secrets
from pathlib import Path

from ..errors import ArtifactError
from .manifest import FileRecord

PARTIAL = ".partial"
"""Suffix of what is being written; never part of an artifact."""


def describe(path: Path) -> FileRecord:
    """Size and hash of a file.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return FileRecord(sha256=hashlib.file_digest(file, "sha256").hexdigest(), bytes=path.stat().st_size)


def content_hash(content: bytes) -> str:
    """The 16 digits that go into a file's name."""
    return hashlib.sha256(content).hexdigest()[:16]


def verify(path: Path, record: FileRecord) -> None:
    """Raise unless the file is what its record says.

    Raises:
        ArtifactError: missing, unreadable, of another size, or of other content.
    """
    again = "Copy the artifact again, or convert the checkpoint again."
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise ArtifactError(f"{path}: expected a file; found something else. {again}")
        if size != record.bytes:
            kind = "truncated" if size < record.bytes else "longer than it was"
            raise ArtifactError(f"{path}: expected {record.bytes} bytes; found {size}: the file is {kind}. {again}")
        found = describe(path).sha256
    except FileNotFoundError:
        raise ArtifactError(f"{path}: the file is missing; manifest.json lists it. {again}") from None
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read: {error}. {again}") from error
    if found != record.sha256:
        raise ArtifactError(
            f"{path}: expected sha256 {record.sha256[:12]}...; found {found[:12]}...: the file was changed since it was"
            f" written. {again}"
        )


def write_synced(path: Path, content: bytes) -> None:
    """Write a new file and wait until it is on disk."""
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def replace_file(path: Path, content: bytes) -> None:
    """Put a file in place at once: other processes see the old content or the new one, and so does a crash."""
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
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}{PARTIAL}")


def sync_directory(path: Path) -> None:
    """Wait until the names in a folder are on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
