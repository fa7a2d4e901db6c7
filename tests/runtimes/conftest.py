from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from ttscompile.artifact import Artifact, load_artifact
from ttscompile.ir.program import Program

from .toys import pencil_program, toy_program, written_artifact

MakeArtifact = Callable[[Program], Artifact]


@pytest.fixture(scope="session")
def toy_artifact(tmp_path_factory: pytest.TempPathFactory) -> Artifact:
    return written_artifact(toy_program(), tmp_path_factory.mktemp("toy") / "artifact")


@pytest.fixture(scope="session")
def pencil_artifact(tmp_path_factory: pytest.TempPathFactory) -> Artifact:
    return written_artifact(pencil_program(), tmp_path_factory.mktemp("pencil") / "artifact")


@pytest.fixture
def own_artifact(toy_artifact: Artifact, tmp_path: Path) -> Artifact:
    """A copy of the toy, for tests that change it."""
    return load_artifact(shutil.copytree(toy_artifact.path, tmp_path / "toy"))


@pytest.fixture
def make_artifact(tmp_path: Path) -> MakeArtifact:
    return lambda program: written_artifact(program, tmp_path / "artifact")
