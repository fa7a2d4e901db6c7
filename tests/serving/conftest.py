from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.plans import store_schedules
from tests.runtimes.executor.conftest import _no_thread_is_left as _no_thread_is_left
from ttscompile import Source
from ttscompile.artifact.load import load_artifact
from ttscompile.core.lattice import uniform_plan
from ttscompile.serving.admission import AUDIT


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


@pytest.fixture(scope="session")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy policy with two plans: ``evenly``, and ``memory``, which reads the call before."""
    from tests.runtimes.toys import toy_program, written_artifact  # they need torch

    artifact = written_artifact(toy_program(pruner=False), tmp_path_factory.mktemp("fleet") / "artifact")
    evenly = uniform_plan(artifact.manifest.steps, len(artifact.manifest.groups), 2)
    memory = np.where(evenly == Source.TIMESTEP, Source.ROLLOUT.value, evenly).astype(np.int8)
    store_schedules(artifact.path, None, {"evenly": evenly, "memory": memory}, "evenly", {})
    cells = load_artifact(artifact.path).plans["memory"].cells
    assert cells is not None and (cells == Source.ROLLOUT).any()
    return artifact.path
