"""Artifacts that the suite shares; a test that changes one takes a copy."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import ttscompile

from . import policies


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small nonlinear policy with a stochastic sampler, not calibrated."""
    directory = tmp_path_factory.mktemp("mixer") / "compiled"
    ttscompile.compile_denoiser(policies.Mixer(0).eval(), policies.spec(), directory)
    return directory


@pytest.fixture(scope="session")
def linear_policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy without a nonlinearity: first-order predictions are exact."""
    directory = tmp_path_factory.mktemp("linear") / "compiled"
    ttscompile.compile_denoiser(policies.Mixer(1, linear=True).eval(), policies.spec(clip=None), directory)
    return directory


@pytest.fixture
def artifact(compiled: Path, tmp_path: Path) -> Path:
    """A copy of ``compiled``."""
    return Path(shutil.copytree(compiled, tmp_path / "compiled"))


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes."""
    return policies.record(tmp_path_factory.mktemp("recording") / "calls.npz")
