from pathlib import Path

import numpy as np
import pytest

from tests.plans import store_schedules
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile import Source
from ttscompile.artifact.load import load_artifact
from ttscompile.core.lattice import uniform_plan


@pytest.fixture(scope="session")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy policy with two plans: ``evenly``, and ``memory``, which reads the call before."""
    artifact = written_artifact(toy_program(pruner=False), tmp_path_factory.mktemp("fleet") / "artifact")
    evenly = uniform_plan(artifact.manifest.steps, len(artifact.manifest.groups), 2)
    memory = np.where(evenly == Source.TIMESTEP, Source.ROLLOUT.value, evenly).astype(np.int8)
    store_schedules(artifact.path, None, {"evenly": evenly, "memory": memory}, "evenly", {})
    cells = load_artifact(artifact.path).plans["memory"].cells
    assert cells is not None and (cells == Source.ROLLOUT).any()
    return artifact.path
