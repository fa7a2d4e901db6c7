"""The examples are scripts, which find each other in their own folder."""

import sys
from pathlib import Path

import pytest

from tests.calibration.conftest import artifact, compiled, planned, recording
from tests.once import Once

__all__ = ["artifact", "compiled", "planned", "recording"]

for _folder in ("ablation", "benchmark", "evaluation", "pusht"):
    sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / _folder))


@pytest.fixture(scope="session")
def tiny_artifact(once: Once) -> Path:
    """Of the benchmark's smallest network: 8 steps, 3 blocks, plans that reuse nothing and half of the cells."""
    from networks import compile_with_plans, random_network

    network = random_network(16, "ddim", 8, layers=1)
    return once.folder("tiny", lambda directory: compile_with_plans(network, directory, (0.0, 0.5, 0.98)))
