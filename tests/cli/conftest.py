"""A toy artifact that several commands are tried on."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.runtimes.toys import toy_program, written_artifact


@pytest.fixture(scope="session")
def toy_compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five steps, five blocks, an untrained pruner, not calibrated. Copy it before changing it."""
    directory = tmp_path_factory.mktemp("toy") / "compiled"
    written_artifact(toy_program(), directory)
    return directory
