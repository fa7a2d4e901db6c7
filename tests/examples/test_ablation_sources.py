"""Ways to fill a cell, on a small policy: by hand where that is possible, and what the script prints."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import sources
import torch
from click.testing import CliRunner
from published import Gate, authors_keep, below, paper_threshold, toca_score

from tests.calibration.tasks import make_task
from tests.pages import ROOT
from tests.rounding import bound
from ttscompile.calibration.calls import Actions
from ttscompile.core.lattice import uniform_plan


@pytest.fixture(scope="module")
def study(compiled: Path, recording: Path) -> sources.Study:
    task = make_task(compiled, recording)
    spec = task.runner.view.manifest.spec
    return sources.Study(task.runner, Actions(spec), task.calls, task.calls, 0)


def test_forecasts_of_first_and_second_order_by_hand(study: sources.Study) -> None:
    kept = [(6, torch.tensor(36.0)), (4, torch.tensor(16.0)), (2, torch.tensor(4.0))]  # squares
    assert [study.forecast(order)(7, 0, torch.tensor(0.0), kept)[0].item() for order in (0, 1)] == [36, 46]
    # slopes 10 and 6, their difference by two steps 2: 36 + 10 + 2 / 2
    assert study.forecast(2)(7, 0, torch.tensor(0.0), kept)[0].item() == 47
    assert study.forecast(2)(7, 0, torch.tensor(0.0), kept[:1])[0].item() == 36


def test_reuse_is_that_of_the_lattice(study: sources.Study) -> None:
    found = study.filled(study.judged, sources.even(10, 4), study.reused)
    assert found.cells == 24
    expected = study.runner.run(uniform_plan(10, 6, 4), study.judged)
    torch.testing.assert_close(found.samples, expected, rtol=1e-4, atol=1e-5)


def test_all_tokens_and_a_threshold_of_nothing_are_the_original(study: sources.Study) -> None:
    dense = study.runner.run_dense(study.judged)[:, -1]
    for found in (study.some_tokens((0,), study.tokens), study.gated(study.judged, below(-1.0), study.reused)):
        assert found.cells == pytest.approx(60)
        torch.testing.assert_close(found.samples, dense, rtol=1e-4, atol=1e-5)


def test_a_threshold_keeps_the_cells(study: sources.Study) -> None:
    threshold = study.threshold(24, study.reused)
    assert 6 <= study.gated(study.learned, below(threshold), study.reused).cells <= 24
    assert study.gated(study.learned, below(0.8 * threshold), study.reused).cells > 20


def test_maps_are_the_best_linear_ones(study: sources.Study) -> None:
    matrix, shift = study.maps[0]
    assert (len(study.maps), matrix.shape, shift.shape) == (6, (32, 32), (32,))
    assert study.row("none", study.filled(study.judged, (0,), study.reused), 100.0).flops > 6 / 60


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(ROOT / "tests" / "rivals" / "golden" / "sources.npz") as arrays:
        return dict(arrays)


def test_fastcache_computes_a_block_where_its_authors_code_does(golden: dict[str, np.ndarray]) -> None:
    """And the threshold of its paper decides nothing: it is above 1."""
    features, theirs = torch.from_numpy(golden["fastcache.features"]), golden["fastcache.computed"]
    _, tokens, width = features.shape
    timesteps = golden["fastcache.timesteps"].tolist()
    gate = Gate(lambda change, k: authors_keep(change, timesteps[k], tokens * width))
    assert 5 < theirs.sum() < len(theirs) - 5
    np.testing.assert_array_equal([bool(gate(k, 0, x.flatten()[None])) for k, x in enumerate(features)], theirs)
    assert golden["fastcache.threshold"] == pytest.approx([paper_threshold(tokens * width)], abs=5e-5)
    assert 1 < paper_threshold(tokens * width) < 1.2
    paper = Gate(lambda change, k: change <= paper_threshold(tokens * width))
    assert sum(bool(paper(k, 0, x.flatten()[None])) for k, x in enumerate(features)) == 1


def test_toca_computes_the_tokens_that_its_authors_code_does(golden: dict[str, np.ndarray]) -> None:
    tokens, cached = (torch.from_numpy(golden[f"toca.{name}"]) for name in ("tokens", "cached"))
    count = golden["toca.chosen"].shape[2]
    waited = torch.zeros(tokens.shape[1:3])
    for given, kept, score, chosen in zip(tokens, cached, golden["toca.score"], golden["toca.chosen"], strict=True):
        mine = toca_score(given, kept, waited)
        np.testing.assert_allclose(mine, score, atol=4 * bound(tokens.shape[3]), rtol=0)
        found = mine.topk(count, 1).indices
        np.testing.assert_array_equal(found.sort(1).values, np.sort(chosen, 1))
        waited = (waited + 1).scatter(1, found, 0.0)
    assert waited.max() > 1


@pytest.mark.slow
def test_the_script_prints_a_row_for_each_way(compiled: Path, recording: Path) -> None:
    asked = [str(compiled), "-t", str(recording), "--computed-steps", "3", "--calls", "8"]
    made = CliRunner().invoke(sources.main, [*asked, "--json"])
    assert made.exit_code == 0, made.output
    rows = json.loads(made.stdout)["rows"]
    assert len(rows) == 15
    assert all(np.isfinite([row["error"], row["flops"]]).all() for row in rows)
    assert all(row["cells"] < 24 for row in rows if "own gate" not in row["way"])
    assert "forecast of the output" in CliRunner().invoke(sources.main, asked).stdout
    refused = CliRunner().invoke(sources.main, [*asked[:3], "--computed-steps", "10"])
    assert "between 2 and 9" in str(refused.exception)
