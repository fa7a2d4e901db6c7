"""The artifact that the tests of this folder take apart."""

from pathlib import Path

import pytest

from tests.artifact.tiny import write_tiny


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """A freshly written artifact."""
    write_tiny(tmp_path / "compiled")
    return tmp_path / "compiled"
