"""A bit flipped anywhere in an artifact is found."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.artifact.folders import flip
from ttscompile.artifact.manifest import MANIFEST
from ttscompile.errors import ArtifactError
from ttscompile.verification.ladder import check_integrity
from ttscompile.verification.rung import FAILED, PASSED

FLIPS = 1000


@pytest.mark.slow
@pytest.mark.parametrize("flips", [FLIPS // 5, pytest.param(FLIPS, marks=pytest.mark.soak)])
def test_random_flips_are_found(flips: int, sound: Path, tmp_path: Path) -> None:
    """Half of them anywhere, in proportion to the size of the files; half in a file drawn at random."""
    artifact = Path(shutil.copytree(sound, tmp_path / "compiled"))
    draw = np.random.default_rng(0)
    files = sorted(artifact.iterdir())
    sizes = np.array([path.stat().st_size for path in files])
    for number in range(flips):
        path = files[draw.choice(len(files), p=sizes / sizes.sum() if number % 2 else None)]
        position, bit = int(draw.integers(path.stat().st_size)), int(draw.integers(8))
        flip(path, position, bit)
        rung, opened = check_integrity(artifact)
        assert rung.status == FAILED, f"{path.name}, byte {position}, bit {bit}"
        assert opened is None
        assert path.name in rung.told
        flip(path, position, bit)
    assert check_integrity(artifact)[0].status == PASSED


@pytest.mark.parametrize(("old", "new"), [(b"\n", b"\n "), (b"true", b"true ")])
def test_another_spelling_of_the_same_manifest_is_found(old: bytes, new: bytes, artifact: Path) -> None:
    path = artifact / MANIFEST
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    rung, _ = check_integrity(artifact)
    assert rung.status == FAILED


def test_all_files_that_are_wrong_are_named_and_nothing_else_is_tried(artifact: Path) -> None:
    flip(artifact / "block_00.onnx", 10)
    (artifact / "block_01.onnx").unlink()
    found = ttscompile.verify(artifact)
    assert [rung.name for rung in found.rungs] == ["integrity"]
    assert found.rungs[0].figure == 2
    assert all(name in found.rungs[0].told for name in ("block_00.onnx", "block_01.onnx"))
    assert found.identity is None


def test_files_beside_the_artifact_are_mentioned(artifact: Path) -> None:
    (artifact / "notes.txt").write_text("nothing of ours")
    rung, _ = check_integrity(artifact)
    assert rung.status == PASSED
    assert "notes.txt" in rung.told


def test_files_that_conversion_puts_there_for_lerobot_are_no_strangers(artifact: Path) -> None:
    (artifact / "config.json").write_text("{}")
    rung, _ = check_integrity(artifact)
    assert rung.told.endswith("have the hashes that they were written with")


def test_what_is_no_artifact_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="does not exist"):
        check_integrity(tmp_path / "nowhere")
    with pytest.raises(ArtifactError, match="not an artifact"):
        check_integrity(tmp_path)
    (tmp_path / "policy.ckpt").write_bytes(b"no zip")
    with pytest.raises(ArtifactError, match="a checkpoint, not an artifact. Convert it first"):
        check_integrity(tmp_path / "policy.ckpt")
