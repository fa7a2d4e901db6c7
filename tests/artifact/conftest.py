"""The artifact that the tests of this folder take apart."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.artifact.tiny import tiny_models, tiny_program
from ttscompile.artifact.write import write_artifact


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """A freshly written artifact."""
    program = tiny_program()
    write_artifact(program, tiny_models(program), tmp_path / "compiled")
    return tmp_path / "compiled"
