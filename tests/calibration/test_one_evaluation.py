"""Policies of one evaluation, without noise: what is learned, in which unit it is judged, and what is said of it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import ttscompile
from tests.once import Once
from ttscompile import ChunkSpec, DirectDenoiser, Noise, ObservationSpec, PolicySpec, direct_table
from ttscompile.artifact.ceiling import NOTHING, few_steps, uncalibrated
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.judge import judge, other_noise
from ttscompile.calibration.pipeline import calibrate
from ttscompile.measure.points import TENTH
from ttscompile.report import facts

from .tasks import distance, trials_of

SPEC = PolicySpec(
    sample=(4, 2), observations={"state": ObservationSpec((1, 3))}, sampler=direct_table(), chunk=ChunkSpec(2, 0, 3)
)


class Network(nn.Module):
    """One number of the state at every place of the chunk, and a product large enough for eight bits."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.inner, self.outer = nn.Linear(3, 64), nn.Linear(64, 2)
        self.places = nn.Parameter(torch.randn(8, 64))

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """``[B, 1, 3]`` -> ``[B, 4, 2]``."""
        tokens = torch.tanh(self.inner(state) + self.places)
        return self.outer(tokens)[:, :4]


@pytest.fixture(scope="module")
def made(once: Once) -> Path:
    """The policy, in eight bits too."""
    network = DirectDenoiser(Network()).eval()
    return once.compiled(
        "one evaluation", lambda directory: ttscompile.compile_denoiser(network, SPEC, directory, precision="int8")
    )[0]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes of four calls."""
    path = tmp_path_factory.mktemp("recorded") / "calls.npz"
    states = np.random.default_rng(0).uniform(-1, 1, (24, 1, 3)).astype(np.float32)
    np.savez(path, state=states, episode_ends=np.arange(4, 25, 4))
    return path


def test_by_hand() -> None:
    """Answers to two observations are 10 apart, whatever the draw; the plan is 0.3 and 0.4 off. A tenth of 10 is 1."""
    y = np.array([[[0.0], [0.0]], [[10.0], [10.0]]])
    x = y + np.array([0.3, 0.4])[:, None, None]
    assert distance(x, y) == pytest.approx(((0.09 + 0.16) / 2) ** 0.5)
    assert distance(y, y) == 0
    assert distance(y[:1] + 0.05, y[:1]) == pytest.approx(0.05 / TENTH), "of one observation the unit is that of 1"
    alike = np.repeat(y[:1], 3, axis=0)
    assert distance(alike + 0.05, alike) == pytest.approx(0.05 / TENTH), "and so it is of several that are the same"


def test_rounding_is_no_noise_and_little_noise_is() -> None:
    """Draws that differ by rounding leave the unit; where they differ by more it is what noise changes."""
    draw = np.random.default_rng(0)
    y = np.repeat(draw.standard_normal((50, 1, 8)), 4, axis=1)
    x = y + 0.01
    rounded = y * (1 + 1e-7 * draw.standard_normal(y.shape))
    assert distance(x, rounded) == pytest.approx(distance(x, y), rel=1e-4)
    noisy = y + 0.01 * draw.standard_normal(y.shape)
    assert distance(noisy + 0.01, noisy) > 5 * distance(x, y)


def test_the_noise_is_not_read(made: Path) -> None:
    """The same actions with any, and those of the network."""
    policy = ttscompile.load(made, plan="dense")
    state = np.random.default_rng(1).standard_normal((2, 1, 3), dtype=np.float32)
    with torch.inference_mode():
        expected = Network()(torch.from_numpy(state)).numpy()
    for seed in range(3):
        noise = Noise(np.random.default_rng(seed).standard_normal((2, 4, 2), dtype=np.float32))
        found = policy.predict_action({"state": state}, noise=noise)["action_pred"]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert policy.info.prefix_refusal is not None


def test_there_is_no_other_noise(made: Path, recorded: Path, tmp_path: Path) -> None:
    """So the original is at no distance, and eight bits are at some."""
    trials = trials_of(made, recorded, tmp_path)
    assert other_noise(trials) == 0
    assert judge(trials, trials.artifact.plans["dense"]).distance < 1e-3
    score = judge(trials, trials.artifact.plans["full"])
    assert 1e-3 < score.distance < 10
    assert (score.sparsity, score.flops_sparsity) == (0, 0)


@pytest.mark.parametrize(("allowed", "told"), [(100.0, "int8 in condition"), (1e-4, "all parts stay fp32")])
def test_precision_is_learned_and_nothing_is_reused(
    made: Path, recorded: Path, tmp_path: Path, allowed: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As ``build`` does it: eight bits where they are near enough. The record says why no schedule was looked for."""
    monkeypatch.setattr("ttscompile.calibration.proposers.precision.Precision.margin", allowed)
    directory = shutil.copytree(made, tmp_path / "artifact")
    result = calibrate(directory, [recorded], learn=("loops", "precision"), max_distance=allowed, progress=False)
    plan = load_artifact(directory).plans[result.default_plan]
    assert result.told["precision"].startswith(told)
    assert plan.cells is not None and (plan.cells == 0).all()
    assert "nothing to reuse between steps" in result.told["loops"]
    record = load_artifact(directory).manifest.calibration
    assert record is not None
    assert any("Noise changes nothing here" in line for line in facts.remarks(record))
    rungs = {rung.name: rung for rung in ttscompile.verify(directory, trajectories=[recorded]).rungs}
    assert {rungs[name].status for name in ("plans", "engaged")} == {"skipped"}


def test_what_is_said_of_one_step(made: Path) -> None:
    """No warning of few steps, and no advice to calibrate."""
    manifest = load_artifact(made).manifest
    assert few_steps(manifest) == uncalibrated(manifest) == NOTHING
