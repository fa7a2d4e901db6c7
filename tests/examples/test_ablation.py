"""The ablation from end to end on a small policy, and what its rows hold."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from ablate import DIRECTIONS, interval, main, pin, rows_of
from click.testing import CliRunner

import ttscompile
from tests.calibration import policies
from tests.once import Once
from ttscompile.calibration import tts
from ttscompile.calibration.calls import Calls
from ttscompile.calibration.pruner.paper import UPDATES
from ttscompile.runtimes.reference.model import Contexts

WAYS = ["searched", "gates", "head", "refined"]


def test_every_way_and_direction_is_a_row_once() -> None:
    rows = [(decided, reads) for decided, reads, _ in rows_of(list(DIRECTIONS), WAYS, UPDATES)]
    assert len(rows) == len(set(rows)) == 1 + 3 + 4 + 1  # a plan for all calls has no use for ROLLOUT


def test_an_interval_is_over_episodes() -> None:
    """Calls of one episode are no evidence of their own: ten of each of two episodes leave the mean open."""
    episodes = np.repeat([0, 1], 10)
    assert interval(np.where(episodes == 0, 1.0, 3.0), episodes) == (1.0, 3.0)
    assert interval(np.full(20, 2.0), episodes) == (2.0, 2.0)


def test_pinned_calls_have_one_noise_a_window() -> None:
    draw = torch.Generator().manual_seed(0)
    noise = torch.randn(3, 8, 2, generator=draw)
    fresh = Calls(Contexts(8, {}), torch.randn(8, 2, generator=draw), noise, np.zeros(8, np.int64), window=4)
    pinned = pin(fresh)
    for calls, same in ((pinned, True), (fresh, False)):
        assert calls.noise is not None
        assert torch.equal(calls.initial[4], calls.initial[7]) == same
        assert torch.equal(calls.noise[:, 4], calls.noise[:, 7]) == same
    assert not torch.equal(pinned.initial[0], pinned.initial[4])


@pytest.mark.slow
def test_it_runs_and_every_row_keeps_the_budget(once: Once, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tts, "MOVED_BY", (1,))
    calls, found = policies.record(tmp_path / "calls.npz", episodes=8), tmp_path / "rows.json"
    sizes = ["--learned", "70", "--judged", "14", "--minutes", "0.02", "--updates", "2", "--pinned"]
    chosen = ["--way", "searched", "--way", "head", "--direction", "all"]
    arguments = [str(policies.compiled(once)), "--trajectories", str(calls), "--json", str(found)]
    arguments += ["--keep", str(tmp_path / "kept")]
    result = CliRunner().invoke(main, [*arguments, *sizes, *chosen], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    told = json.loads(found.read_text())
    assert (told["cells"], told["window"], told["pinned"]) == (60, 7, True)
    assert [(row["decided"], row["reads"]) for row in told["rows"]] == [
        ("even steps", "TIMESTEP"),
        *[("searched steps", "TIMESTEP")] * 2,
        *[("head for each call", "all")] * 2,
    ]
    assert all(0 < row["updates"] <= 2 for row in told["rows"][3:])
    for row in told["rows"]:
        assert row["cells"] <= 18
        assert row["interval"][0] - 1e-6 <= row["error"] <= row["interval"][1] + 1e-6
    assert "head for each call" in result.output
    kept = ttscompile.load(tmp_path / "kept")
    kept.predict_action({"obs": np.zeros((1, 2, 3), np.float32)})
    assert kept.last_report is not None
    assert (kept.info.default_plan, kept.last_report.computed[0] <= 18) == ("found", True)
