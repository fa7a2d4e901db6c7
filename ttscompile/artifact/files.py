"""Files on disk: hashes, and writes that either happened or did not."""

import ctypes
import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
import stat
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from io import BufferedReader
from pathlib import Path

from ..errors import ArtifactChangedError, ArtifactError
from .manifest import FileRecord

PARTIAL = ".partial"
"""Suffix of what is being written; never part of an artifact."""


def describe(path: Path) -> FileRecord:
    """Size and hash of a file. Raises OSError: it cannot be read."""
    with path.open("rb") as file:
        return FileRecord(sha256=_sha256(file), bytes=path.stat().st_size)


def _sha256(file: BufferedReader) -> str:
    """The hash of what is left to read, as ``hashlib.file_digest`` of Python 3.11 makes it."""
    digest, part = hashlib.sha256(), memoryview(bytearray(2**18))
    while size := file.readinto(part):
        digest.update(part[:size])
    return digest.hexdigest()


def content_hash(content: bytes) -> str:
    """The 16 digits that go into a file's name."""
    return hashlib.sha256(content).hexdigest()[:16]


_AGAIN = "Copy the artifact again, or convert the checkpoint again."


@contextmanager
def opened(path: Path) -> Iterator[BufferedReader]:
    """A file to read from, now and within the block. Anything else is refused unread: a pipe may never end."""
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
    """The content of a file of at most so many bytes; of a larger one no more is read, and the last is too many."""
    with opened(path) as file:
        return file.read(min(limit, os.fstat(file.fileno()).st_size) + 1)  # Python allocates what is asked for


def check_file(path: Path, record: FileRecord) -> None:
    """Raise unless the file is what its record says."""
    with opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size != record.bytes:
            kind = "truncated" if size < record.bytes else "longer than it was"
            raise ArtifactError(f"{path}: expected {record.bytes} bytes; found {size}: the file is {kind}. {_AGAIN}")
        found = _sha256(file)
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


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Within the block an error of the system is one of writing an artifact, whose place nothing has taken."""
    try:
        yield
    except OSError as error:
        raise ArtifactError(
            f"{target}: the artifact cannot be written: {error}. What was there is unharmed."
        ) from error


def replace_folder(partial: Path, target: Path) -> None:
    """Put a finished folder in the place of another, which is removed: at every moment one of the two stands there.

    Linux exchanges two names at once. Where the file system cannot (NFS and some others), the old folder is renamed
    first; a crash between the two renames then leaves it beside ``target`` under a name that ends with ``.replaced``,
    from where ``recover`` puts it back. A process that works in the old folder works in the new one afterwards.
    """
    old, inside = partial, target.exists() and target.samefile(os.curdir)
    if not target.exists():
        partial.replace(target)
    elif not exchange(partial, target):
        old = aside(target, "replaced")
        target.replace(old)
        try:
            partial.replace(target)
        except BaseException:
            old.replace(target)
            raise
    if inside:
        os.chdir(target)
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
def locked(directory: Path) -> Iterator[None]:
    """Keep all others from calibrating, converting to, or updating an artifact; a kill ends this, too.

    Raises:
        ArtifactError: somebody else is at it; or it cannot be locked.
    """
    with ExitStack() as held:
        try:
            held.enter_context(lock_folder(directory))
        except BlockingIOError:
            raise ArtifactError(
                f"{directory}: another process is changing the artifact: it calibrates it, or converts a checkpoint to"
                " this directory. Try again when it is done."
            ) from None
        except OSError as error:  # no permission; a file system without locks
            raise ArtifactError(f"{directory}: cannot be locked, and was not changed: {error}.") from error
        yield


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
    old = aside(target, "replaced")
    if old.is_dir() and not target.exists():
        old.replace(target)
    shutil.rmtree(old, ignore_errors=True)


def aside(target: Path, ending: str) -> Path:
    """A hidden name in the same folder, always the same."""
    return target.with_name(f".{_short(target.name)}.{ending}")


HELD = "/proc/self/fd"
"""Where a process finds what it holds open, by the number of the descriptor."""

Stamp = tuple[int, ...] | None
"""What changes when a file is written, replaced, or moved away and back; None where there is none."""


class Folder:
    """An artifact's directory while it is read: what was checked is what is used, whatever takes its place meanwhile.

    It is held open as long as this object lives, by a descriptor, and files are named through that,
    ``/proc/self/fd/N/NAME``: the directory stays the one that was opened, wherever its name leads by then.
    (onnxruntime opens models and weights by name; arrays given to it would be held twice.) What happens to the files
    inside shows in their stamps, which are compared before and after. A file that was moved away and came back, or was
    written in place, has another time of change.

    Where there is no such ``/proc``, as on macOS, files are named by the path as it was given, and the directory has a
    stamp as well: exchanged and exchanged back, it has another time of change, too.

    Args:
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
