"""Which calls are learned from, on a small policy: what is chosen, and what the script prints."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import recordings
import torch
from click.testing import CliRunner

from tests.calibration import policies
from tests.once import Once


def test_what_covers_is_furthest_from_what_was_chosen_before() -> None:
    line = torch.tensor([[0.0], [1.0], [2.0], [9.0], [10.0]])  # its mean is 4.4
    assert recordings.chosen_to_cover(line, 2).tolist() == [4, 0]
    assert recordings.chosen_to_cover(line, 3).tolist() == [4, 0, 2]
    assert sorted(recordings.chosen_to_cover(line, 9)) == [0, 1, 2, 3, 4]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return policies.record(tmp_path_factory.mktemp("calls") / "calls.npz", 8)


@pytest.mark.slow
def test_it_prints_a_row_for_each_number_of_episodes(once: Once, recorded: Path) -> None:
    words = [str(policies.compiled(once)), "-t", str(recorded), "--step", "3", "--episodes", "2", "--episodes", "50"]
    words += ["--calls", "8", "--judged", "8", "--draws", "2"]
    made = CliRunner().invoke(recordings.main, [*words, "--json"])
    assert made.exit_code == 0, made.output
    few, all_ = json.loads(made.stdout)["rows"]
    assert (few["episodes"], all_["episodes"]) == (2, 6), "two of eight are held out"
    for row in (few, all_):
        assert row["calls"] == 8 and np.isfinite(list(row["errors"].values())).all()
        mean, least, most = row["gain"]["to cover"]
        assert least <= mean <= most
    shown = CliRunner().invoke(recordings.main, words)
    assert "error, at random" in shown.stdout and "8 calls of 2 other episodes" in shown.stdout.replace("\n", " ")


def test_a_step_that_the_loop_lacks_is_refused(once: Once, recorded: Path) -> None:
    made = CliRunner().invoke(recordings.main, [str(policies.compiled(once)), "-t", str(recorded), "--step", "99"])
    assert made.exit_code != 0 and "found 99" in str(made.exception)
