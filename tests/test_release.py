"""What is released is what is in the tree, under one version; ``make release`` installs it into empty environments."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

from tests.runtimes.toys import toy_program, written_artifact
from ttscompile import __version__
from ttscompile.measure.versions import VERSION

from . import release


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return release.build(tmp_path_factory.mktemp("release"), isolated=False)


def test_sdist_and_wheel_are_whole_and_pass_the_check_of_the_index(built: tuple[Path, Path]) -> None:
    assert release.missing_or_more(built[1]) == set()
    release.check(built)
    with tarfile.open(built[0]) as opened:
        names = {name.partition("/")[2] for name in opened.getnames()}
    assert {"LICENSE", "README.md", "CHANGELOG.md", "pyproject.toml", "passes/hoist.py"} <= names
    assert not any(name.startswith(("tests", "examples", "build")) for name in names)


def test_the_wheel_runs_an_artifact(built: tuple[Path, Path], tmp_path: Path) -> None:
    """With the packages of this environment, and none of the tree; ``make release`` takes an empty one."""
    artifact = written_artifact(toy_program(), tmp_path / "artifact").path
    target = tmp_path / "target"
    release.run([sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(target), str(built[1])])
    assert {each.name for each in target.iterdir()} == {"bin", "ttscompile", f"ttscompile-{VERSION}.dist-info"}
    done = subprocess.run(
        [sys.executable, "-P", "-c", release.CALLS, str(artifact), VERSION],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(target)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(target)


def test_a_file_that_is_forgotten_is_found(built: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(release, "HOMES", {**release.HOMES, "docs": "ttscompile/docs"})
    assert "ttscompile/docs/design.md" in release.missing_or_more(built[1])


def test_the_version_is_said_once_and_the_changelog_has_it() -> None:
    assert __version__ == VERSION
    assert release.project()["dynamic"] == ["version"] and "version" not in release.project()
    said = [
        str(path.relative_to(release.ROOT))
        for top in release.HOMES
        for path in (release.ROOT / top).rglob("*.py")
        if f'"{VERSION}"' in path.read_text()
    ]
    assert said == ["ttscompile/measure/versions.py"]
    assert len(release.changes(VERSION)) > 1000
    assert release.changes("0.0.9") == ""
