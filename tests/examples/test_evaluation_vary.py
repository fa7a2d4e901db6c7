"""What comes of calibrations that differ in one thing, and of a policy in the course of an episode."""

import json
from pathlib import Path
from typing import Any

import click
import drift
import numpy as np
import pytest
import vary
from bootstrap import Estimate
from click.testing import CliRunner
from environments.pusht import PushT
from record import save_trajectories
from rollout import Episode, action_errors
from torch import Tensor, nn
from variants import NoiseShape, Variant, seeded_noise

import ttscompile
from tests.once import Once
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.samplers.flow import flow_matching_table

SHAPE = NoiseShape(3, (4, 2), False)


def episode(seed: int, calls: int, share: float = 1.0, executed: int = 8) -> Episode:
    """Of a policy that counts by ``share``; of the last chunk so many actions were executed."""
    observed = np.full((calls, 2, 20), seed, np.float32) + np.arange(calls, dtype=np.float32)[:, None, None]
    policy = Counting(share)
    made = [
        policy.predict_action({"obs": one[None]}, seeded_noise(SHAPE, [seed], i), None)["action"][0]
        for i, one in enumerate(observed)
    ]
    actions = np.concatenate(made)[: 8 * (calls - 1) + executed]
    return Episode(seed, "", {"obs": observed}, actions, np.linspace(0, 1, len(actions)), True, {})


class Counting:
    """Answers with the number of calls since its reset, and with what it observes."""

    def __init__(self, share: float) -> None:
        self.share, self.calls = share, 0

    def reset(self) -> None:
        self.calls = 0

    def predict_action(self, obs_dict: Any, noise: Any, plan: Any) -> Any:
        self.calls += 1
        made = obs_dict["obs"][:, :1, :2] + noise.initial[:, :1] + self.share * self.calls
        return {"action": np.repeat(made, 8, axis=1)}


def counting(label: str) -> Variant:
    policy: Any = Counting(3.0)
    return Variant(label, policy, None, SHAPE)


def test_errors_are_of_calls_in_order_and_end_with_the_episode() -> None:
    ours = counting("ours")
    found = action_errors(ours, [episode(1, 3), episode(2, 1, executed=3)])
    np.testing.assert_allclose(found, np.array([[2, 4, 6], [2, np.nan, np.nan]]), rtol=1e-5)
    np.testing.assert_allclose(action_errors(ours, [episode(1, 3)]), [[2, 4, 6]], rtol=1e-5)
    np.testing.assert_allclose(action_errors(ours, [episode(1, 3, share=3.0)]), [[0, 0, 0]], atol=1e-5)


def test_a_drift_keeps_what_a_tenth_of_the_episodes_reached() -> None:
    dense = counting("dense")
    episodes = [episode(1, 4), *(episode(seed, 2) for seed in range(2, 13))]
    found = drift.measured("ours", dense, episodes, episodes)
    assert [one.mean for one in found.errors] == pytest.approx([2, 4]), "one of twelve goes on"
    np.testing.assert_array_equal(found.running, [1, 1])
    np.testing.assert_array_equal(found.scores, found.dense)
    assert found.scores[1] == pytest.approx(11 / 12 + 15 / 31 / 12)


@pytest.mark.parametrize("text", ["episodes", "episodes=", "hours=1,2", "seed=a"])
def test_what_may_differ_is_said(text: str) -> None:
    with pytest.raises(click.UsageError, match=r"expected one of episodes, minutes, seed, '=' and numbers"):
        vary.parsed(text)


class Pusher(nn.Module):
    """A denoiser for Push-T, of random weights."""

    def __init__(self) -> None:
        super().__init__()
        self.embed, self.observe, self.head = nn.Linear(2, 8), nn.Linear(40, 8), nn.Linear(8, 2)
        self.layers = nn.ModuleList(nn.Linear(8, 8) for _ in range(2))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        condition = (self.observe(obs.flatten(1) / 512) + timestep[:, None])[:, None]
        x = self.embed(sample)
        for layer in self.layers:
            x = x + layer(x + condition).tanh()
        made: Tensor = self.head(x)
        return made


@pytest.mark.soak
def test_both_commands(once: Once, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = PolicySpec((8, 2), {"obs": ObservationSpec((2, 20))}, flow_matching_table(4), ChunkSpec(2, 1, 8))
    source = once.folder("pusher", lambda folder: ttscompile.compile_denoiser(Pusher().eval(), spec, folder / "it"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(PushT, "max_steps", 24)
    rng = np.random.default_rng(0)
    recorded = rng.normal(256, 80, (3, 9, 2, 20)).astype(np.float32)
    save_trajectories(Path("calls.npz"), [{"obs": each} for each in recorded])
    given = ["--trajectories", "calls.npz", "-o", "varied", "--target-sparsity", "0.5", "--max-minutes", "0.01"]
    words = [str(source / "it"), *given, "--episodes", "2", "--json", "--picture", "varied.png"]

    def run(script: click.Command, *words: str) -> str:
        result = CliRunner().invoke(script, words, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.stdout

    found = json.loads(run(vary.main, *words, "--over", "episodes=2,3"))["calibrations"]
    assert [one["value"] for one in found] == [2, 3]
    for one in found:
        assert (one["computed"][0], len(one["computed"])) == (0, 2)
        assert 0 < one["error"]["low"] <= one["error"]["mean"]
    assert Path("varied.png").read_bytes()[:4] == b"\x89PNG"
    stamps = {path: path.stat().st_mtime_ns for path in Path("varied").glob("*/manifest.json")}
    assert json.loads(run(vary.main, *words, "--over", "episodes=2,3"))["calibrations"] == found
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps, "nothing was calibrated anew"
    result = CliRunner().invoke(vary.main, [*words, "--over", "episodes=4"])
    assert (result.exit_code, "the recordings hold 3" in result.output) == (2, True)
    result = CliRunner().invoke(vary.main, [*words, "--over", "episodes=2", "--target-sparsity", "0.25"])
    assert (result.exit_code, "give another --output" in result.output) == (2, True), (
        "what is kept is of another budget"
    )

    told = run(drift.main, "varied/episodes-2", "--episodes", "2", "--picture", "drift.png", "--json")
    (one,) = json.loads(told)["variants"]
    assert len(one["errors"]) == len(one["scores"]) == len(one["scores_dense"])
    assert min(error["mean"] for error in one["errors"]) > 0
    assert "varied/episodes-2" in run(drift.main, "varied/episodes-2", "--episodes", "2")


def test_the_pictures_are_the_same_files_twice(tmp_path: Path) -> None:
    ends = Estimate(0.9, 0.8, 0.95)
    rows = [vary.Varied(value, (0, 2), 1.0, ends, ends, ends, ends) for value in (2.0, 4.0)]
    for name in ("one.png", "two.png"):
        vary.draw("episodes", rows, ends, tmp_path / name, "T")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
