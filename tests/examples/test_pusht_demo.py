"""The tables that the demo ends with; ``make demo`` runs the rest."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark import Measurement
from demo import ALL_COMPUTED, COMPILED, ORIGINAL, calibration_table, compare, conclusion, final_table
from episodes import Episodes
from evaluate import Evaluation, summarise
from rollout import Episode, Rollout
from variants import open_variant

from tests.examples.printed import printed
from ttscompile import Plan
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.calibration.judge import Score
from ttscompile.calibration.result import CalibrationResult
from ttscompile.core.lattice import dense_plan, uniform_plan
from ttscompile.core.plan import FULL


def cells(table: Any) -> list[list[str]]:
    return [[cell.strip() for cell in line.replace("┃", "│").split("│")[1:-1]] for line in printed(table, 160)]


def rollout(coverage: float, seed: int = 0) -> Rollout:
    one = Episode(
        seed,
        "",
        {"obs": np.zeros((1, 2, 20), np.float32)},
        np.zeros((1, 2)),
        np.array([min(coverage / 0.95, 1.0)]),
        coverage > 0.95,
        {"best coverage": coverage},
        (0.95,),
        (1e9,),
        (0,),
    )
    return Rollout((one,), (1.0,))


SPEEDS = [
    Measurement("eager PyTorch", (1000.0,), None, None, 25e9, 0.0, None),
    Measurement("dense onnxruntime", (500.0,), 1.0, 0.0, 24e9, 0.0, None),
    Measurement("compiled", (25.0,), 1.0, 0.1, 1.2e9, 0.95, None),
]


def evaluations(original: float, dense: float, compiled: float) -> list[Evaluation]:
    """Of one episode each, which covered so much of the goal."""
    first = rollout(original)
    return [
        summarise(name, rollout(c) if c != original else first, first)
        for name, c in (("original", original), ("dense", dense), ("compiled", compiled))
    ]


def test_final_table_has_speed_and_score_of_each() -> None:
    rows = cells(final_table(SPEEDS, evaluations(0.97, 0.96, 0.76)))
    assert ["", "original", "16 steps, all computed", "compiled"] in rows
    assert ["ms a call, 1 thread", "1000.0", "500.0", "25.0"] in rows
    assert ["calls a second", "1.0", "2.0", "40.0"] in rows
    assert ["times faster than the original", "1.0", "2.0", "40.0"] in rows
    assert ["GFLOP a call", "25.00", "24.00", "1.20"] in rows
    assert ["blocks reused, not computed", "0.0%", "0.0%", "95.0%"] in rows
    assert ["success", "100% [100%, 100%]", "100% [100%, 100%]", "0% [0%, 0%]"] in rows
    one = "1.000 [1.000, 1.000]"
    assert ["score, at most 1", one, one, "0.800 [0.800, 0.800]"] in rows
    assert ["its difference from the original", "", "+0.000 [+0.000, +0.000]", "-0.200 [-0.200, -0.200]"] in rows
    assert ["its difference from the original", "", "+0% [+0%, +0%]", "-100% [-100%, -100%]"] in rows
    assert ["its difference from all computed", "", "", "-100% [-100%, -100%]"] in rows


def test_the_conclusion_says_whether_success_was_kept() -> None:
    kept = conclusion(SPEEDS, evaluations(0.97, 0.96, 0.98))
    assert kept.startswith("A compiled call takes 25 ms where the original takes 1000 ms: it is 40 times faster.")
    assert "Its success is not told apart from that of the original:" in kept
    assert "not told apart from that of the same 16 steps, all computed:" in kept
    assert kept.endswith("These are 1 episodes; docs/evidence/results.md has 200.")
    lost = conclusion(SPEEDS, evaluations(0.97, 0.5, 0.6))
    assert "Its success is lower than that of the original." in lost
    assert "not told apart from that of the same 16 steps, all computed:" in lost
    assert "Its success is higher than that of the same 16 steps" in conclusion(SPEEDS, evaluations(0.97, 0.5, 0.96))


@pytest.mark.slow
def test_episodes_that_were_run_before_are_compared(compiled_pusht: Path, tmp_path: Path) -> None:
    """Without running any: the three policies, from the files of their episodes to the figures."""
    artifact = shutil.copytree(compiled_pusht, tmp_path / "compiled")
    manifest = load_artifact(artifact).manifest
    shape = manifest.steps, len(manifest.blocks)
    plans = {FULL: Plan(cells=dense_plan(*shape)), "one": Plan(cells=uniform_plan(*shape, 1))}
    update_plans(artifact, plans, "one", {"strategy": "interval"})
    for text, coverage in ((f"{artifact}:dense", 0.8), (f"{artifact}:full", 0.75), (str(artifact), 0.7)):
        cache = Episodes(tmp_path / "episodes", "pusht", open_variant(text, "onnxruntime", 1), "onnxruntime")
        for seed in (7, 8):
            cache.write(rollout(coverage, seed).episodes[0])
    found = compare(artifact, (7, 8), 2, 2)
    assert [one.label for one in found] == [ORIGINAL, ALL_COMPUTED, COMPILED]
    assert [round(one.score.mean * 0.95, 6) for one in found] == [0.8, 0.75, 0.7]


def test_calibration_table_names_the_default_and_the_baseline() -> None:
    result = CalibrationResult(
        learned=("schedule",),
        strategy="tts",
        seed=0,
        target_sparsity=0.95,
        default_plan="schedule",
        plans={
            "schedule": Score(0.1104, (0.05, 0.17), None, None, 0.95, 0.94, 0.93, 1),
            "uniform": Score(0.91, (0.8, 1.2), None, None, 0.95, 0.95, 0.94, 1),
        },
        episodes={"calibration": (0, 1), "validation": (2,)},
        calls={"calibration": 20, "validation": 10},
        intervals=3,
        stopped="finished",
        seconds=60.0,
    )
    rows = cells(calibration_table(result))
    assert ["schedule (default)", "0.110", "[0.050, 0.170]", "95.0%", "93.0%"] in rows
    assert ["uniform", "0.910", "[0.800, 1.200]", "95.0%", "94.0%"] in rows


@pytest.mark.slow
def test_a_bad_checkpoint_is_one_clear_error(tmp_path: Path) -> None:
    bad = tmp_path / "not-a-policy.ckpt"
    bad.write_text("nothing of the kind")
    script = Path(__file__).parents[2] / "examples" / "pusht" / "demo.py"
    command = [sys.executable, str(script), "--checkpoint", str(bad), "--directory", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert "not-a-policy.ckpt" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list((tmp_path / "out").iterdir())
