"""The first rung: the bytes are those that were written."""

from __future__ import annotations

from pathlib import Path

from ..artifact.archive import is_checkpoint
from ..artifact.codec import encode
from ..artifact.files import check_file
from ..artifact.load import Artifact, load_artifact, read_manifest
from ..artifact.manifest import MANIFEST
from ..errors import ArtifactError
from .rung import FAILED, PASSED, Rung

NAME = "integrity"


def check_integrity(path: Path) -> tuple[Rung, Artifact | None]:
    """Hash every file, and open the artifact.

    Args:
        path: the artifact's directory, or the same zipped.

    Returns:
        The rung, and the artifact; None if the rung failed.

    Raises:
        ArtifactError: there is nothing at this path that could be an artifact.
    """
    if not path.exists() or (path.is_dir() and not (path / MANIFEST).is_file()) or is_checkpoint(path):
        load_artifact(path)  # says what is wrong
    wrong = _wrong_files(path) if path.is_dir() else []
    artifact = None
    if not wrong:
        try:
            artifact = load_artifact(path)
        except ArtifactError as error:
            wrong = [str(error)]
    if artifact is None:
        remedy = "Copy the artifact again, or convert the checkpoint again."
        told = f"{len(wrong)} of its files are not as written: " * (len(wrong) > 1) + " ".join(wrong)
        return Rung(NAME, FAILED, told, len(wrong), 0, "files", remedy, details={"wrong": wrong}), None
    files = artifact.manifest.files
    size = sum(record.bytes for record in files.values()) / 1e6
    other = sorted({p.name for p in path.iterdir()} - {MANIFEST, *files}) if path.is_dir() else []
    lie = f"{len(other)} other file{'s lie' if len(other) > 1 else ' lies'} beside them"
    more = f"; {lie}, which nothing reads: {', '.join(other[:3])}" if other else ""
    told = f"manifest and {len(files)} files, {size:.1f} MB, have the hashes that they were written with{more}"
    return Rung(NAME, PASSED, told, 0, 0, "files", details={"unlisted": other}), artifact


def _wrong_files(directory: Path) -> list[str]:
    """What is wrong with the manifest or with each file that it lists."""
    try:
        manifest = read_manifest(directory)
    except ArtifactError as error:
        return [str(error)]
    wrong = []
    for name, record in manifest.files.items():
        try:
            check_file(directory / name, record)
        except ArtifactError as error:
            wrong.append(str(error))
    # Two spellings of one document have one checksum.
    if not wrong and encode(manifest) != (directory / MANIFEST).read_bytes():
        wrong = [f"{directory / MANIFEST}: is written otherwise than ttscompile writes it; the file was changed."]
    return wrong
