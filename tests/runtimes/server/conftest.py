from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.runtimes.executor.conftest import _no_thread_is_left, toy_compiled
from ttscompile.runtimes.server.admission import AUDIT

__all__ = ["_no_thread_is_left", "toy_compiled"]


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
