"""The artifact that the tests of this folder take apart."""

import shutil
from pathlib import Path

import pytest

from tests.artifact.tiny import write_tiny
from tests.once import Once


@pytest.fixture
def written(once: Once, tmp_path: Path) -> Path:
    """The policy of two blocks as it was written: a copy for each test."""
    return shutil.copytree(once.folder("two blocks", write_tiny), tmp_path / "compiled")
