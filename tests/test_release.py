"""What is released is what is in the tree, under one version; ``make release`` installs it into empty environments."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.runtimes.toys import toy_program, written_artifact
from ttscompile import __version__
from ttscompile.measure.versions import VERSION

from . import release
from .machines import matrix


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return release.build(tmp_path_factory.mktemp("release"), isolated=False)


@pytest.mark.slow
def test_sdist_and_wheel_are_whole_and_pass_the_check_of_the_index(built: tuple[Path, Path]) -> None:
    assert release.missing_or_more(built[1]) == set()
    release.check(built)
    with tarfile.open(built[0]) as opened:
        names = {name.partition("/")[2] for name in opened.getnames()}
    assert {"LICENSE", "README.md", "CHANGELOG.md", "pyproject.toml", "passes/hoist.py"} <= names
    assert not any(name.startswith(("tests", "examples", "build")) for name in names)


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.parametrize(
    ("tag", "version", "why"),
    [
        (f"v{VERSION}", VERSION, None),
        (None, VERSION, None),
        (VERSION, VERSION, f"the tag is {VERSION}, .* Expected v{VERSION}"),
        (f"v{VERSION}rc1", VERSION, f"the tag is v{VERSION}rc1"),
        ("", VERSION, "the tag is ,"),
        ("v0.0.9", "0.0.9", "no section '## 0.0.9 - DATE'"),
    ],
)
def test_a_tag_is_the_version_and_the_changelog_has_it(tag: str | None, version: str, why: str | None) -> None:
    found = release.not_ready(tag, version)
    assert (found is None) if why is None else re.search(why, found or "")


def test_a_wrong_tag_ends_a_release_before_anything_is_built(tmp_path: Path) -> None:
    words = (sys.executable, release.ROOT / "tests" / "release.py", tmp_path / "out", "v9.9.9")
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("error: the tag is v9.9.9")
    assert list(tmp_path.iterdir()) == []


def workflow(name: str) -> dict[Any, Any]:
    """A workflow; YAML reads its key ``on`` as true."""
    read: dict[Any, Any] = yaml.safe_load((release.ROOT / ".github" / "workflows" / f"{name}.yml").read_text())
    return read


def test_continuous_integration_runs_all_tests_on_each_python_that_the_package_names() -> None:
    """But for the first, on which artifacts run: there what a robot needs is tried."""
    jobs = workflow("ci")["jobs"]
    job, robot = jobs["test"], jobs["robot"]["steps"]
    named = [str(each).rpartition(" ")[2] for each in release.project()["classifiers"] if "Python :: 3." in each]
    assert job["strategy"]["matrix"]["python"] == named[1:]
    assert robot[1]["with"]["python-version"].split() == named[:2]
    assert robot[-1]["run"] == "make test-matrix"
    assert list(matrix.PYTHONS) == named
    assert f">={named[0]}" == release.project()["requires-python"]
    assert job["env"]["PYTHON"] == "python${{ matrix.python }}"
    assert job["steps"][-1]["run"] == ".ci/run"
    assert (release.ROOT / ".ci" / "run").read_text().splitlines()[-1] == "make test"


def test_a_tag_is_published_without_a_password_after_make_release() -> None:
    document = workflow("release")
    assert document[True] == {"push": {"tags": ["v*"]}}
    build, publish = document["jobs"]["build"], document["jobs"]["publish"]
    assert 'make release TAG="$GITHUB_REF_NAME"' in [step.get("run") for step in build["steps"]]
    assert "release.py build/release $(TAG)\n" in (release.ROOT / "Makefile").read_text()
    assert publish["needs"] == "build"
    assert publish["permissions"] == {"id-token": "write"}
    assert document["permissions"] == {"contents": "read"}, "and nobody else may write anything"
    kept, taken = build["steps"][-1]["with"], publish["steps"][0]["with"]
    assert (kept["path"], kept["name"]) == ("build/release/", taken["name"])
    assert (publish["steps"][-1]["uses"], taken["path"]) == ("pypa/gh-action-pypi-publish@release/v1", "dist/")
    assert "secrets" not in str(document)


def test_the_project_says_where_it_is_at_home() -> None:
    urls = release.project()["urls"]
    assert set(urls) == {"Homepage", "Documentation", "Issues", "Changelog"}
    place = urls["Homepage"]
    for url in urls.values():
        assert url.startswith(place)
        _, _, path = url.partition("/blob/main/")
        assert (release.ROOT / path).exists(), url
