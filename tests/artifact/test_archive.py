import errno
import gc
import os
import shutil
import stat
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import pytest

from tests.artifact.folders import Edit, flip, packed
from ttscompile.artifact import archive, load_artifact
from ttscompile.core.zip_files import MAX_ENTRIES
from ttscompile.errors import ArtifactChangedError, ArtifactError

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("prefix", ["", "compiled/", "./"])
def test_a_zipped_artifact(written: Path, prefix: str) -> None:
    directory = load_artifact(written)
    artifact = load_artifact(packed(written, prefix))
    assert artifact.manifest.identity == directory.manifest.identity
    assert artifact.weights["tail.weight"].tobytes() == directory.weights["tail.weight"].tobytes()
    assert artifact.graph("stem") == directory.graph("stem")


def test_the_folder_lives_as_long_as_the_artifact(written: Path) -> None:
    artifact = load_artifact(packed(written))
    folder = artifact.path
    gc.collect()
    assert (artifact.path / artifact.manifest.pieces["stem"].file).is_file()
    del artifact
    gc.collect()
    assert not folder.exists()


def test_folder_entries_and_strangers_are_not_unpacked(written: Path) -> None:
    def edit(file: zipfile.ZipFile) -> None:
        file.mkdir("compiled")
        file.writestr("compiled/README.txt", "hello")

    artifact = load_artifact(packed(written, "compiled/", edit))
    assert "README.txt" not in {path.name for path in artifact.path.iterdir()}


def linked(file: zipfile.ZipFile) -> None:
    info = zipfile.ZipInfo("passwords")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    file.writestr(info, "/etc/passwd")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda f: f.writestr("../evil.txt", "x"), "leaves the archive"),
        (lambda f: f.writestr("a/../../evil.txt", "x"), "leaves the archive"),
        (lambda f: f.writestr("/tmp/evil.txt", "x"), "leaves the archive"),
        (lambda f: f.writestr("..\\evil.txt", "x"), "leaves the archive"),
        (lambda f: f.writestr("C:evil.txt", "x"), "leaves the archive"),
        (linked, "link or a device"),
        (lambda f: f.writestr("deep/er/file", "x"), "one folder at most"),
        (lambda f: f.writestr("other/file", "x"), "one folder at most"),
    ],
)
def test_entries_that_no_artifact_has(
    written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edit: Edit, message: str
) -> None:
    folders = watch(monkeypatch)
    path = packed(written, edit=edit)
    before = set(tmp_path.rglob("*"))
    with pytest.raises(ArtifactError, match=message):
        load_artifact(path)
    assert set(tmp_path.rglob("*")) == before
    assert folders
    assert not any(folder.exists() for folder in folders)


def watch(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The temporary folders that are made from now on."""
    folders: list[Path] = []
    original = tempfile.mkdtemp

    def mkdtemp(prefix: str) -> str:
        folders.append(Path(original(prefix=prefix)))
        return str(folders[-1])

    monkeypatch.setattr(tempfile, "mkdtemp", mkdtemp)
    return folders


def test_two_entries_of_one_name(written: Path) -> None:
    with pytest.warns(UserWarning, match="Duplicate name"):
        path = packed(written, edit=lambda f: f.writestr("stem.onnx", "x"))
    with pytest.raises(ArtifactError, match="same name"):
        load_artifact(path)


def test_a_missing_file(written: Path) -> None:
    with pytest.raises(ArtifactError, match="stem.onnx is missing"):
        load_artifact(packed(written, skip="stem.onnx"))


def test_a_checkpoint_in_place_of_an_artifact(written: Path) -> None:
    (written.parent / "lerobot").mkdir()
    (written.parent / "lerobot" / "config.json").touch()
    (written.parent / "legacy.ckpt").write_bytes(b"no zip")
    with zipfile.ZipFile(written.parent / "policy.bin", "w") as file:
        file.writestr("archive/data.pkl", b"x")
        file.writestr("archive/data/0", b"x")
    for name in ("lerobot", "legacy.ckpt", "policy.bin"):
        with pytest.raises(ArtifactError, match=f"{name}: a checkpoint, not an artifact. Convert it first: ttscompile"):
            load_artifact(written.parent / name)


def test_an_archive_without_a_manifest(written: Path) -> None:
    path = packed(written, skip="manifest.json")
    with pytest.raises(ArtifactError, match="expected manifest.json in the archive"):
        load_artifact(path)


@pytest.mark.parametrize("content", [b"", b"PK", b"hello" * 100])
def test_a_file_that_is_no_archive(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(ArtifactError, match="not a zip file"):
        load_artifact(tmp_path / "a.zip")


def test_every_truncation_is_found(written: Path) -> None:
    path = packed(written)
    content = path.read_bytes()
    for size in range(0, len(content) - 1, 97):
        path.write_bytes(content[:size])
        with pytest.raises(ArtifactError):
            load_artifact(path)


@pytest.mark.slow
def test_flipped_bits_are_found_or_harmless(written: Path) -> None:
    """Attributes and dates of the entries may change, contents may not."""
    path = packed(written)
    content = path.read_bytes()
    expected = load_artifact(written)
    for position in range(0, len(content), 61):
        path.write_bytes(content)
        flip(path, position, position % 8)
        try:
            artifact = load_artifact(path)
        except ArtifactError:
            continue
        assert artifact.manifest.identity == expected.manifest.identity
        assert artifact.weights["tail.weight"].tobytes() == expected.weights["tail.weight"].tobytes()


def test_damage_inside_is_reported_with_the_name_of_the_archive(written: Path) -> None:
    flip(written / "stem.onnx", 5)
    with pytest.raises(ArtifactError, match=r"artifact\.zip/stem\.onnx: .*changed since"):
        load_artifact(packed(written))


def test_a_size_that_differs_from_the_declared_one(written: Path) -> None:
    with (written / "stem.onnx").open("ab") as file:
        file.write(b"more")
    with pytest.raises(ArtifactError, match="stem.onnx: expected .* bytes"):
        load_artifact(packed(written))


def test_an_archive_out_of_proportion(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = packed(written)
    monkeypatch.setattr(archive, "FREE_BYTES", 0)
    monkeypatch.setattr(archive, "MAX_RATIO", 1)
    with pytest.raises(ArtifactError, match="in so small an archive"):
        load_artifact(path)


def test_too_many_entries(written: Path) -> None:
    def edit(file: zipfile.ZipFile) -> None:
        for i in range(MAX_ENTRIES):
            file.writestr(f"{i}", b"")

    with pytest.raises(ArtifactError, match="at most 10,000 entries"):
        load_artifact(packed(written, edit=edit))


def test_a_forked_child_leaves_its_parents_folder_alone(written: Path) -> None:
    """However the child ends, and whether or not it lets go of the artifact."""
    path = packed(written)
    script = f"""
import gc, os, sys
from ttscompile.artifact import load_artifact
artifact = load_artifact({str(path)!r})
folder = artifact.path
for ending in (sys.exit, os._exit):
    child = os.fork()
    if child == 0:
        del artifact
        gc.collect()
        ending(0)
    os.waitpid(child, 0)
    print(folder.is_dir(), len(artifact.graphs) > 0)
del artifact
gc.collect()
print(folder.exists())
"""
    environment = {**os.environ, "ORT_DISABLE_TELEMETRY": "1"}  # the end of a child would wait for its threads
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env=environment,
        timeout=60,
    )
    assert done.stdout.split() == ["True", "True", "True", "True", "False"]


def test_an_unpacked_folder_that_was_removed_is_told_by_the_name_of_the_archive(written: Path) -> None:
    path = packed(written)
    artifact = load_artifact(path)
    shutil.rmtree(artifact.path)
    with pytest.raises(ArtifactChangedError, match=rf"^{path}: what it was unpacked to, .* was changed or removed"):
        _ = artifact.graphs


def test_without_a_place_for_temporary_files(written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = packed(written)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    with pytest.raises(ArtifactError, match=r"artifact\.zip: cannot be unpacked .*none.* Set TMPDIR"):
        load_artifact(path)


def test_a_full_disk_is_not_told_as_a_bad_archive(
    written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, folders = packed(written), watch(monkeypatch)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(shutil, "copyfileobj", full)
    with pytest.raises(ArtifactError, match=r"artifact\.zip: cannot be unpacked .*No space left.* Set TMPDIR"):
        load_artifact(path)
    assert folders
    assert not any(folder.exists() for folder in folders)
