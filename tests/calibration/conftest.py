"""Artifacts that the suite shares; a test that changes one takes a copy."""

import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

import ttscompile
from tests.once import Once
from tests.plans import store_schedules
from ttscompile.calibration import regression, step_counts, trials, tts
from ttscompile.core.lattice import uniform_plan

from . import policies, tasks

EPOCHS = regression.EPOCHS


@pytest.fixture(autouse=True, scope="package")
def _short_search() -> Iterator[None]:
    """Intervals of all phases, and few of them; networks of corrections learn for a while; few draws of noise.

    Of ten steps, all placements of two are tried; of more than two, steps are moved.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trials, "MOST_DRAWS", trials.DRAWS)
        patch.setattr(step_counts, "MOST_PLACEMENTS", 9)
        patch.setattr(tts, "MOVED_BY", (1,))
        patch.setattr(regression, "EPOCHS", 10)
        yield


@pytest.fixture
def long_training(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks of corrections learn as long as they do outside these tests."""
    monkeypatch.setattr(regression, "EPOCHS", EPOCHS)


@pytest.fixture(scope="session")
def compiled(once: Once) -> Path:
    """A small nonlinear policy with a stochastic sampler, not calibrated."""
    return policies.compiled(once)


@pytest.fixture(scope="session")
def linear_policy(once: Once) -> Path:
    """A policy without a nonlinearity: first-order predictions are exact."""
    module, spec = policies.Mixer(1, linear=True).eval(), policies.spec(clip=None)
    return once.compiled("linear mixer", lambda directory: ttscompile.compile_denoiser(module, spec, directory))[0]


@pytest.fixture
def artifact(compiled: Path, tmp_path: Path) -> Path:
    """A copy of ``compiled``."""
    return Path(shutil.copytree(compiled, tmp_path / "compiled"))


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes."""
    return policies.record(tmp_path_factory.mktemp("recording") / "calls.npz")


@pytest.fixture(scope="session")
def scheduled(compiled: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``compiled`` with a schedule that computes two of its ten steps; not to be changed."""
    directory = shutil.copytree(compiled, tmp_path_factory.mktemp("scheduled") / "compiled")
    return policies.whole_steps(Path(directory), recording)


@pytest.fixture(scope="session")
def planned(compiled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``compiled`` with a plan, ``half``."""
    directory = Path(shutil.copytree(compiled, tmp_path_factory.mktemp("planned") / "compiled"))
    record = {"episodes": {"validation": [0, 1]}}
    store_schedules(directory, None, {"half": uniform_plan(10, 6, 5)}, "half", record)
    return directory


@pytest.fixture(scope="session")
def make_task(compiled: Path, recording: Path) -> tasks.MakeTask:
    """Makes tasks on ``compiled``."""
    return partial(tasks.make_task, compiled, recording)
