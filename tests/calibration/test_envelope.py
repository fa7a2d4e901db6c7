"""What calibration says of what it was given, so that a call can be told to be far outside of it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.compare import compare
from ttscompile.calibration.regression import envelope_of
from ttscompile.core.envelope import FAR
from ttscompile.trajectories import load_trajectories


def test_the_furthest_recorded_call_is_one_away() -> None:
    """Two numbers that vary apart, by 1 and by 100: both count alike, and what never varied does not."""
    draw = torch.Generator().manual_seed(0)
    condition = torch.cat(
        [torch.randn(4000, 2, generator=draw) * torch.tensor([1.0, 100.0]) + 5, torch.ones(4000, 1)], 1
    )
    envelope = envelope_of(condition, np.arange(4000) % 8, 64)
    assert envelope is not None and envelope.reading.shape == (3, 2)
    distances = envelope.distance(condition.numpy())
    assert distances.max() == pytest.approx(1, abs=1e-5)
    middle = condition.mean(0)
    steps = torch.eye(3) * torch.tensor([10.0, 1000.0, 0.1])
    ten, thousand, other = envelope.distance((middle + steps).numpy())
    assert ten == pytest.approx(thousand, rel=0.2) and ten > 2
    assert other < 0.05


def test_components_are_of_every_other_episode() -> None:
    """What the others alone have decides what is far, and is no reason to take nothing for far."""
    draw = torch.Generator().manual_seed(0)
    condition, episodes = torch.randn(200, 3, generator=draw), np.arange(200) % 4
    condition[torch.from_numpy(episodes % 2 == 1)] *= 10
    envelope = envelope_of(condition, episodes, 64)
    assert envelope is not None
    distances = envelope.distance(condition.numpy())
    assert distances.max() == pytest.approx(1, abs=1e-5)
    assert distances[episodes % 2 == 0].max() < 0.2


def test_a_condition_that_says_nothing_gives_none() -> None:
    assert envelope_of(torch.ones(40, 3), np.arange(40) % 4, 64) is None
    assert envelope_of(torch.randn(40, 3), np.arange(40) % 4, 0) is None


@pytest.mark.slow
def test_an_artifact_knows_what_it_was_calibrated_on(compiled: Path, recording: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(compiled, tmp_path / "compiled"))
    ttscompile.calibrate(folder, [recording], target_sparsity=0.7, max_intervals=2, progress=False)
    artifact = load_artifact(folder)
    assert artifact.envelope is not None and artifact.plans["schedule"].correction is not None
    policy = ttscompile.load(folder, plan="schedule")
    recorded = load_trajectories([recording], artifact.manifest.spec.observations, 4)[0].observations["obs"][:1]
    for times, far in ((1, False), (100, True)):
        policy.reset()
        policy.predict_action({"obs": times * recorded})
        report = policy.last_report
        assert report is not None and report.far == far == (report.outside[0] > FAR)
    points = {one.name: one for one in compare(folder, [recording], calls=4).points}
    half, most, furthest = points["schedule"].outside
    assert 0 < half <= most <= furthest < FAR, "held-out calls of the same recording"
    assert points["dense"].outside == (), "it has no correction, and nothing is said of it"
    with np.load(recording) as known:
        nearer = {name: np.float32(0.3) * known[name] if name == "obs" else known[name] for name in known.files}
    np.savez(tmp_path / "nearer.npz", **nearer)
    ttscompile.calibrate(folder, [tmp_path / "nearer.npz"], target_sparsity=0.7, max_intervals=2, progress=False)
    after = load_artifact(folder)
    assert after.envelope is not None
    assert not np.array_equal(after.envelope.center, artifact.envelope.center), "it is of the last recordings"
    policy.reset()
    policy.predict_action({"obs": 100 * recorded}, plan="dense")
    assert policy.last_report is not None and policy.last_report.outside == ()
