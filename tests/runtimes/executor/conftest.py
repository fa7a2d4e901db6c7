from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.once import Once
from tests.runtimes.toys import toy_program, written_artifact

from .simulation import workers


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    assert workers() == []
    yield
    assert workers() == []


@pytest.fixture(scope="session")
def toy_compiled(once: Once) -> Path:
    """The toy policy as an artifact: two actions a chunk, an observation without history, a pruner."""
    return once.folder("toy", lambda directory: written_artifact(toy_program(), directory))
