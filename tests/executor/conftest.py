from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.runtimes.toys import toy_program, written_artifact

from .simulation import workers


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    assert workers() == []
    yield
    assert workers() == []


@pytest.fixture(scope="session")
def toy_compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy policy as an artifact: two actions a chunk, an observation without history, a pruner."""
    return written_artifact(toy_program(), tmp_path_factory.mktemp("toy") / "artifact").path
