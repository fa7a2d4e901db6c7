"""The tables that the demo ends with; ``make demo`` runs the rest."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo import ORIGINAL, SAFE, Step, best_of, conclusion, drive, speed_table
from episodes import Episodes
from equivalence import SCORE_MARGIN, SUCCESS_MARGIN, Verdict
from evaluate import Evaluation, summarise, verdict_table, verdicts_of
from rollout import Episode, Rollout
from variants import open_variant

from tests.examples.printed import printed
from ttscompile import Plan
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.core.lattice import uniform_plan


def cells(table: Any) -> list[list[str]]:
    return [[cell.strip() for cell in line.replace("┃", "│").split("│")[1:-1]] for line in printed(table, 160)]


def episode(coverage: float, seed: int) -> Episode:
    return Episode(
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


def evaluations(*solved: int) -> list[Evaluation]:
    """Of 400 episodes each, of which the first so many were solved; of a negative number the last."""
    which = [range(n) if n > 0 else range(400 + n, 400) for n in solved]
    rollouts = [Rollout(tuple(episode(0.96 if i in own else 0.9, i) for i in range(400)), (1.0,)) for own in which]
    names = (ORIGINAL, "schedule", SAFE)
    return [summarise(name, rollout, rollouts[0]) for name, rollout in zip(names, rollouts, strict=False)]


def verdicts(*solved: int) -> list[tuple[Verdict, Verdict]]:
    return verdicts_of(evaluations(*solved), (SCORE_MARGIN, SUCCESS_MARGIN))


STEPS = [
    Step("the original, in PyTorch", 30.0),
    Step("compiled, everything computed", 10.0),
    Step("2 steps computed", 4.0),
    Step("8-bit weights in blocks", 3.0),
]


def test_each_step_has_its_own_factor() -> None:
    rows = cells(speed_table(STEPS))
    assert ["the original, in PyTorch", "30.00", "", ""] in rows
    assert ["compiled, everything computed", "10.00", "3.0 x", "3.0 x"] in rows
    assert ["2 steps computed", "4.00", "2.5 x", "7.5 x"] in rows
    assert ["8-bit weights in blocks", "3.00", "1.3 x", "10.0 x"] in rows


def test_the_conclusion_has_a_margin_and_a_number_of_episodes() -> None:
    (same,) = verdicts(200, 200)
    faster = "Plan 'schedule' takes 3.0 ms a call, and is 10 times faster. "
    within = "0.03 of the score and 5% of success is lost"
    assert conclusion("schedule", STEPS, same) == (
        f"{faster}It is equivalent to the original: less than {within}, in 400 episodes."
    )
    (unclear,) = verdicts(200, -200)
    said = conclusion("schedule", STEPS, unclear)
    assert said.startswith(f"{faster}400 episodes are too few to say whether {within}; ") and said.endswith("0 may do.")
    (lost,) = verdicts(200, 100)
    assert conclusion("schedule", STEPS, lost).startswith(f"{faster}It is worse than the original")


def test_the_fastest_equivalent_plan_is_shown() -> None:
    assert best_of(evaluations(200, 200, 200)) == 0
    assert best_of(evaluations(200, 100, 200)) == 1
    assert best_of(evaluations(200, 100, 100)) == 1  # none: the nearest
    assert best_of(evaluations(200, 100)) == 0


def test_the_table_of_verdicts_names_what_was_allowed() -> None:
    found = evaluations(200, 100, 200)
    text = "\n".join(printed(verdict_table(found, verdicts_of(found, (0.03, 0.05))), 160))
    assert "as good as original? 400 paired episodes" in text
    assert "equivalent: less than 0.03 of the score and 5% of success is lost, all 2 rows hold with 95 %" in text
    rows = [row for row in cells(verdict_table(found, verdicts_of(found, (0.03, 0.05)))) if row]
    assert [row[:2] for row in rows if row[0] in ("schedule", "safe")] == [
        ["schedule", "worse"],
        ["safe", "equivalent"],
    ]


@pytest.mark.slow
def test_episodes_that_were_run_before_are_compared(compiled_pusht: Path, tmp_path: Path) -> None:
    """Without running any: the policies, from the files of their episodes to the figures."""
    artifact = shutil.copytree(compiled_pusht, tmp_path / "compiled")
    manifest = load_artifact(artifact).manifest
    shape = manifest.steps, len(manifest.blocks)
    update_plans(artifact, {"one": Plan(cells=uniform_plan(*shape, 1))}, "one", {"strategy": "interval"})
    for text, coverage in ((f"{artifact}:dense", 0.8), (f"{artifact}:one", 0.7)):
        cache = Episodes(tmp_path / "episodes", "pusht", open_variant(text, "onnxruntime", 1), "onnxruntime")
        for seed in (7, 8):
            cache.write(episode(coverage, seed))
    found = drive(artifact, ["one"], (7, 8), 2, 2)
    assert [one.label for one in found] == [ORIGINAL, "one"]
    assert [round(one.score.mean * 0.95, 6) for one in found] == [0.8, 0.7]


@pytest.mark.slow
def test_a_folder_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    script = Path(__file__).parents[2] / "examples" / "pusht" / "demo.py"
    command = [sys.executable, str(script), "--directory", str(tmp_path / "file")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].startswith(("error: ", "Error: "))
    assert "Traceback" not in done.stderr
