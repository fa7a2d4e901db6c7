"""A toy artifact that several commands are tried on."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.once import Once
from tests.runtimes.toys import toy_program, written_artifact


@pytest.fixture(scope="session")
def toy_compiled(once: Once) -> Path:
    """Five steps, five blocks, an untrained pruner, not calibrated. Copy it before changing it."""
    return once.folder("toy", lambda directory: written_artifact(toy_program(), directory))
