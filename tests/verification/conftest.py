"""A calibrated artifact with a golden record, to be broken in copies."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.calibration import policies
from tests.once import Once
from tests.plans import store_schedules
from tests.runtimes.plans import random_reading
from ttscompile.artifact.load import load_artifact
from ttscompile.core.correction import no_correction
from ttscompile.core.lattice import Source
from ttscompile.ir.program import Program
from ttscompile.verification.record_golden import record_plans

from . import policy


@pytest.fixture(scope="session")
def made(once: Once) -> tuple[Path, Program]:
    """An artifact that is not calibrated, and the program that it holds."""
    network = policy.Network().eval()
    return once.compiled("verified", lambda to: ttscompile.compile_denoiser(network, policy.spec(), to))


@pytest.fixture(scope="session")
def compiled(made: tuple[Path, Program]) -> Path:
    """The artifact."""
    return made[0]


@pytest.fixture(scope="session")
def program(made: tuple[Path, Program]) -> Program:
    """The program."""
    return made[1]


@pytest.fixture(scope="session")
def recording(once: Once) -> Path:
    """Six episodes."""

    def record(folder: Path) -> None:
        folder.mkdir()
        policies.record(folder / "calls.npz")

    return once.folder("six episodes", record) / "calls.npz"


def calibrate(compiled: Path, directory: Path) -> None:
    """The same with a corrected schedule, its default, another one, and plans that the pruner makes."""
    shutil.copytree(compiled, directory)
    corrected = no_correction(policy.STEPS, (policy.HORIZON, policy.CHANNELS))
    corrected.weights[2:] += np.random.default_rng(0).normal(0, 0.002, corrected.weights[2:].shape)
    corrected.anchors[[0, 4, 8]] = True
    reading = random_reading(np.random.default_rng(1), load_artifact(directory).manifest.condition_numbers, corrected)
    corrected = replace(corrected, reading=reading[0], observed=0.05 * reading[1])
    pruner = {name: np.array(value) for name, value in load_artifact(directory).pruner.items()}
    pruner["pruner.base"][...] = np.eye(4)[policy.sparse()] - 0.5 * np.eye(4)[Source.ROLLOUT]
    pruner["pruner.step"] *= 10
    pruner["pruner.block"] *= 3  # so that plans depend on the observation
    store_schedules(
        directory,
        pruner,
        {"schedule": policy.sparse(), "other": policy.other()},
        "schedule",
        {"learned": ["by hand"]},
        corrections={"schedule": corrected},
        golden=record_plans,
    )


@pytest.fixture(scope="session")
def sound(compiled: Path, once: Once) -> Path:
    """As ``calibrate`` leaves it."""
    return once.folder("verified and sound", lambda directory: calibrate(compiled, directory))


@pytest.fixture(scope="session")
def quick(compiled: Path, once: Once) -> Path:
    """The same with one plan, which saves so much that it is the faster one beside any other work."""

    def calibrate_once(directory: Path) -> None:
        plans = {"schedule": policy.sparsest()}
        shutil.copytree(compiled, directory)
        store_schedules(directory, None, plans, "schedule", {"learned": ["by hand"]}, golden=record_plans)

    return once.folder("verified and quick", calibrate_once)


@pytest.fixture
def artifact(sound: Path, tmp_path: Path) -> Path:
    """A copy of ``sound``."""
    return Path(shutil.copytree(sound, tmp_path / "compiled"))
