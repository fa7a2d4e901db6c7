"""A zipped artifact, unpacked without trusting it: only declared files, only plain names, only declared sizes."""

import shutil
import stat
import tempfile
import weakref
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from ..core.zip_files import open_zip
from ..errors import ArtifactError
from ..measure.process import Process
from .codec import MAX_MANIFEST_BYTES, decode
from .files import opened
from .manifest import MANIFEST

MAX_RATIO = 20
"""Deflate reaches 1000 on zeros; real weights 1.1. Beyond this, and beyond ``FREE_BYTES``, it is a bomb."""
FREE_BYTES = 256 * 2**20
CHUNK = 2**20
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""What ``zip`` writes. The others that Python reads cost much more memory or time for a byte of the archive."""

_ENCRYPTED = 0x1
_UNREADABLE = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, OSError)
_AGAIN = "Zip the artifact's directory again, or give the directory itself."


class Unpacked:
    """A temporary folder that goes at ``remove()`` or when this object does, but for its copy in a forked process.

    Raises:
        OSError: there is no place for temporary files.
    """

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="ttscompile-"))
        self.remove = weakref.finalize(self, _remove, self.path, Process())


def _remove(folder: Path, process: Process) -> None:
    if not process.left:
        shutil.rmtree(folder, ignore_errors=True)


def unpack(path: Path) -> Unpacked:
    """Unpack a zipped artifact into a temporary folder: the files that the manifest declares, and no others.

    They may stand at the top of the archive or all in one folder, as ``zip -r a.zip compiled/`` puts them. Names and
    kinds of entries that no artifact has are refused, and sizes that are out of proportion.
    """
    try:
        unpacked = Unpacked()
    except OSError as error:
        raise _no_room(path, error) from error
    try:
        with opened(path) as file, open_zip(file) as archive:
            _extract(archive, path, unpacked.path)
    except _UNREADABLE as error:
        unpacked.remove()
        raise ArtifactError(f"{path}: not a zip file that can be read: {error}. {_AGAIN}") from error
    except BaseException:
        unpacked.remove()
        raise
    return unpacked


def _no_room(path: Path, error: OSError) -> ArtifactError:
    return ArtifactError(
        f"{path}: cannot be unpacked into a temporary folder: {error}. Set TMPDIR to a folder with room, or unzip the"
        " artifact yourself and give its directory."
    )


def is_checkpoint(path: Path) -> bool:
    """Whether something that is no artifact is what ``convert`` takes: told by names, for the error to say so."""
    if path.is_dir():
        return (path / "config.json").is_file() and not (path / MANIFEST).exists()
    try:
        with path.open("rb") as file, open_zip(file) as archive:
            return any(PurePosixPath(name).name == "data.pkl" for name in archive.namelist())  # of torch.save
    except _UNREADABLE:
        return path.suffix in (".ckpt", ".pt", ".pth", ".safetensors")


def _extract(archive: zipfile.ZipFile, path: Path, folder: Path) -> None:
    entries = _entries(archive, path)
    if MANIFEST not in entries:
        raise ArtifactError(
            f"{path}: not an artifact: expected {MANIFEST} in the archive; found {sorted(entries)[:5]}. {_AGAIN}"
        )
    allowed = max(FREE_BYTES, MAX_RATIO * path.stat().st_size)
    _copy(archive, entries[MANIFEST], min(entries[MANIFEST].file_size, MAX_MANIFEST_BYTES), path, folder / MANIFEST)
    manifest = decode((folder / MANIFEST).read_bytes(), f"{path}: {MANIFEST}")
    total = sum(record.bytes for record in manifest.files.values())
    if total > allowed:
        raise ArtifactError(
            f"{path}: expected at most {allowed} bytes in so small an archive; its manifest declares {total}. {_AGAIN}"
        )
    for name, record in manifest.files.items():
        if name in entries:
            _copy(archive, entries[name], record.bytes, path, folder / name)
        elif name != manifest.apart:
            raise ArtifactError(f"{path}: the file {name} is missing; {MANIFEST} lists it. {_AGAIN}")


def _entries(archive: zipfile.ZipFile, path: Path) -> dict[str, zipfile.ZipInfo]:
    """The files of the archive by plain name; every entry is checked, also those that nobody will read."""
    files = []
    for info in archive.infolist():
        kind = stat.S_IFMT(info.external_attr >> 16)
        name = PurePosixPath(info.filename)
        if name.is_absolute() or ".." in name.parts or "\\" in info.filename or ":" in info.filename:
            raise ArtifactError(f"{path}: entry {info.filename!r} leaves the archive; found in no artifact. {_AGAIN}")
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR) or not info.filename:
            raise ArtifactError(f"{path}: entry {info.filename!r} is a link or a device, not a file. {_AGAIN}")
        if info.compress_type not in METHODS or info.flag_bits & _ENCRYPTED:
            raise ArtifactError(
                f"{path}: entry {info.filename!r} is encrypted or compressed by another method than deflate, which"
                f" 'zip -r' uses. {_AGAIN}"
            )
        if not info.is_dir():
            files.append((name, info))
    folders = {name.parent for name, _ in files}
    if len(folders) > 1 or any(len(folder.parts) > 1 for folder in folders):
        raise ArtifactError(
            f"{path}: not an artifact: expected files in one folder at most; found {sorted(map(str, folders))[:5]}."
            f" {_AGAIN}"
        )
    entries = {name.name: info for name, info in files}
    if len(entries) != len(files):
        raise ArtifactError(f"{path}: two entries have the same name. {_AGAIN}")
    return entries


def _copy(archive: zipfile.ZipFile, info: zipfile.ZipInfo, size: int, path: Path, target: Path) -> None:
    """Write the content of an entry, which has to be of exactly this size, to a new file."""
    if info.file_size != size:
        raise ArtifactError(f"{path}: {info.filename}: expected {size} bytes; found {info.file_size}. {_AGAIN}")
    with archive.open(info) as source:
        try:
            with target.open("xb") as file:
                shutil.copyfileobj(source, file, CHUNK)  # never more than the directory says, which was compared above
        except OSError as error:  # of the disk; damage to the archive has errors of its own
            raise _no_room(path, error) from error
    if (found := target.stat().st_size) != size:
        raise ArtifactError(f"{path}: {info.filename}: expected {size} bytes; found {found}. {_AGAIN}")
