"""EVO's search with what episodes score as fitness: who drives, what is minimised, and what the command tells."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import evolved
import numpy as np
import pytest
from click.testing import CliRunner
from variants import Variant

from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.task import Found
from ttscompile.calibration.trials import base_of
from ttscompile.core.lattice import uniform_plan


def test_a_candidate_drives_its_cells_on_the_same_seeds(
    four_steps: Path, whole: Variant, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[Any, list[int]]] = []

    def drives(make: object, variant: Any, seeds: Sequence[int], batch: int) -> SimpleNamespace:
        seen.append((variant, list(seeds)))
        return SimpleNamespace(episodes=[SimpleNamespace(score=score) for score in (0.25, 0.75)])

    monkeypatch.setattr(evolved, "run_episodes", drives)
    driven = evolved.Driven(dict, whole, base_of(load_artifact(four_steps)), range(7, 9), 2)
    schedule = uniform_plan(4, 3, 2)
    assert driven.lost(schedule) == driven.lost(schedule) == 0.5
    assert [seeds for _, seeds in seen] == [[7, 8], [7, 8]]
    candidate, _ = seen[0]
    np.testing.assert_array_equal(candidate.plan.cells, schedule)
    assert candidate.plan.loop == base_of(load_artifact(four_steps)).loop
    assert driven.with_plan("a name", Found(schedule)).label == "a name"


@pytest.mark.slow
def test_it_tells_of_both_searches(four_steps: Path, tmp_path: Path) -> None:
    draw, calls = np.random.default_rng(0), tmp_path / "calls.npz"
    np.savez(calls, obs=draw.uniform(150, 350, (24, 2, 20)).astype(np.float32), episode_ends=np.arange(6, 25, 6))
    words = ["--population", "2", "--generations", "2", "--episodes", "1", "--judged", "2", "--computed", "0.5"]
    arguments = [str(four_steps), "-t", str(calls), *words]
    told = CliRunner().invoke(evolved.main, [*arguments, "--json"], catch_exceptions=False)
    assert told.exit_code == 0, told.output
    document = json.loads(told.stdout)
    labels = [row["label"] for row in document["rows"]]
    assert labels[0].endswith(":full") and [one for one in labels if "corrected" not in one][1:] == [
        "error",
        "episodes",
    ]
    assert document["budget"] == 6 and document["rows"][1]["sparsity"] == 0.5
    assert set(document["seconds_a_generation"]) == {"error", "episodes"}
    assert len(document["against_error"]["score_difference"]) > 1
    shown = " ".join(CliRunner().invoke(evolved.main, arguments, catch_exceptions=False).stdout.split())
    assert "seeds 100001..100002" in shown and "Seconds of the processor" in shown
