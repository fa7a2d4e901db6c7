from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.once import Once
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile.runtimes.server.admission import AUDIT

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


@pytest.fixture
def audit() -> Iterator[Any]:
    """The lines so far; with a number, as soon as there are so many."""
    written: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: written.append(record.getMessage())  # type: ignore[method-assign]
    AUDIT.addHandler(handler)
    AUDIT.setLevel(logging.INFO)

    def lines(least: int = 0) -> list[dict[str, Any]]:
        end = time.monotonic() + 10
        while len(written) < least and time.monotonic() < end:
            time.sleep(0.01)
        return [json.loads(each) for each in written]

    yield lines
    AUDIT.removeHandler(handler)
    AUDIT.setLevel(logging.NOTSET)
