"""The examples are scripts, which find each other in their own folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import ttscompile
from tests.calibration.conftest import artifact, compiled, planned, recording
from tests.once import Once

if TYPE_CHECKING:
    from variants import Variant

__all__ = ["artifact", "compiled", "planned", "recording"]

for _folder in ("ablation", "benchmark", "evaluation", "pusht"):
    sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / _folder))


@pytest.fixture(scope="session")
def tiny_artifact(once: Once) -> Path:
    """Of the benchmark's smallest network: 8 steps, 3 blocks, plans that reuse nothing and half of the cells."""
    from networks import compile_with_plans, random_network

    network = random_network(16, "ddim", 8, layers=1)
    return once.folder("tiny", lambda directory: compile_with_plans(network, directory, (0.0, 0.5, 0.98)))


@pytest.fixture(scope="session")
def four_steps(once: Once, one_layer_checkpoint: Path) -> Path:
    """The artifact of ``one_layer_checkpoint`` with four steps of DDIM, all of which ``full`` computes."""
    path, _ = once.compiled(
        "one layer, ddim 4", lambda at: ttscompile.convert(one_layer_checkpoint, at, sampler="ddim", steps=4)
    )
    return path


@pytest.fixture
def whole(four_steps: Path) -> Variant:
    """Drives with that, and has kept nothing yet."""
    from variants import open_variant

    return open_variant(f"{four_steps}:full", "onnxruntime", 1)
