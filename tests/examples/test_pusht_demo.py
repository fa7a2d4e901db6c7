"""The tables that the demo ends with; ``make demo`` runs the rest."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import demo
import numpy as np
import pytest
from demo import LOOKS, ORIGINAL, Step, best_of, conclusion, drive, settle, speed_table, steps_to, time_steps
from episodes import Episodes
from equivalence import EQUIVALENT, SCORE_MARGIN, SUCCESS_MARGIN, TOO_FEW, WORSE, Verdict, joined, verdict
from evaluate import Evaluation, summarise, verdict_table, verdicts_of
from rollout import Episode, Rollout
from variants import open_variant, run

from tests.examples.printed import printed
from ttscompile import Plan, Source
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.calibration.step_counts import SAFE
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.spec import BF16, INT8


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
    assert conclusion("schedule", STEPS, lost) == f"{faster}It is worse than the original."


def test_what_is_worse_in_one_measure_is_worse() -> None:
    """Though the other is not settled."""
    zeros, wide = [0.0] * 400, [3.0, -3.0] * 200
    unclear, lost = verdict(wide, zeros, SCORE_MARGIN), verdict([0.0] * 400, [1.0] * 400, SUCCESS_MARGIN, shares=True)
    assert (unclear.word, lost.word) == (TOO_FEW, WORSE)
    said = conclusion("schedule", STEPS, (unclear, lost))
    assert said.endswith("times faster. It is worse than the original.") and "too few" not in said


def test_the_fastest_equivalent_plan_is_shown() -> None:
    assert best_of(verdicts(200, 200, 200)) == 0
    assert best_of(verdicts(200, 100, 200)) == 1
    assert best_of(verdicts(200, 100, 100)) == 1  # none: the nearest
    assert best_of(verdicts(200, 100)) == 0


FIRST, SECOND = (["schedule"], 400), (["schedule"], 800)


@pytest.mark.parametrize(
    ("solved", "looked"),
    [
        ([(200, 200)], [(["schedule"], 400)]),
        ([(200, 180), (200, 199)], [(["schedule"], 400), (["schedule"], 800)]),
        (
            [(200, 100), (200, 100), (200, 100, 200)],
            [(["schedule"], 400), (["schedule"], 800), (["schedule", SAFE], 800)],
        ),
    ],
    ids=["at the first look", "in twice as many", "not before safe"],
)
def test_the_robot_is_driven_until_a_plan_is_equivalent(
    solved: list[tuple[int, ...]], looked: list[tuple[list[str], int]]
) -> None:
    asked, coming = list[tuple[list[str], int]](), iter(solved)

    def driven(plans: Sequence[str], count: int) -> list[Evaluation]:
        asked.append((list(plans), count))
        return evaluations(*next(coming))

    last, said = settle(["schedule", SAFE], 400, driven)
    assert asked == looked
    assert joined(said[-1]) == EQUIVALENT
    # They share the error, and so does the look at ``safe`` that there may be.
    assert {each.comparisons for pair in said for each in pair} == {(LOOKS + 1) * len(said)}
    assert "in 3 looks together" in str(verdict_table(last, said).caption)


def test_a_single_plan_is_looked_at_twice_at_most() -> None:
    coming = iter([(200, 100), (200, 100)])
    _, said = settle(["schedule"], 400, lambda plans, count: evaluations(*next(coming)))
    assert [each.comparisons for pair in said for each in pair] == [LOOKS, LOOKS] and joined(said[0]) == WORSE


def test_the_steps_to_a_plan_are_named_by_what_it_says() -> None:
    """And each has the plan that is timed for it."""
    cells = np.full((4, 3), Source.TIMESTEP, np.int8)
    cells[[0, 2]] = Source.COMPUTE
    cells[3, 0] = Source.COMPUTE
    first, two = {"compiled, everything computed": "dense"}, "2 steps computed"
    assert steps_to("dense", Plan()) == first
    assert steps_to("fast", Plan(cells=cells)) == {**first, two: "fast"}
    assert steps_to("pruner", Plan()) == {**first, "the cells computed that the pruner chooses": "pruner"}
    small = steps_to("fast", Plan(cells=cells, precision={"blocks": INT8, "condition": INT8, "tail": BF16}))
    assert small == {**first, two: "fast@fp32", "8-bit weights in blocks, condition; 16-bit weights in tail": "fast"}


@pytest.mark.slow
def test_each_step_is_timed(compiled_layer: Path, one_layer_checkpoint: Path, tmp_path: Path) -> None:
    artifact = shutil.copytree(compiled_layer, tmp_path / "compiled")
    update_plans(artifact, {"ten": Plan(cells=uniform_plan(100, 3, 10))}, "ten", {"learned": ["interval"]})
    steps = time_steps(one_layer_checkpoint, artifact, "ten", 2)
    named = ["the original, in PyTorch", "compiled, everything computed", "10 steps computed"]
    assert [step.what for step in steps] == named
    assert all(step.ms > 0 for step in steps) and steps[2].ms < steps[1].ms
    assert [step.what for step in time_steps(one_layer_checkpoint, artifact, "dense", 1)] == named[:2]


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
    update_plans(artifact, {"one": Plan(cells=uniform_plan(*shape, 1))}, "one", {"learned": ["interval"]})
    for text, coverage in ((f"{artifact}:dense", 0.8), (f"{artifact}:one", 0.7)):
        cache = Episodes(tmp_path / "episodes", "pusht", open_variant(text, "onnxruntime", 1), "onnxruntime")
        for seed in (7, 8):
            cache.write(episode(coverage, seed))
    found = drive(artifact, ["one"], (7, 8), 2, 2)
    assert [one.label for one in found] == [ORIGINAL, "one"]
    assert [round(one.score.mean * 0.95, 6) for one in found] == [0.8, 0.7]


def test_a_bad_checkpoint_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And nothing is left behind but the folder that it would have worked in."""
    bad = tmp_path / "not-a-policy.ckpt"
    bad.write_text("nothing of the kind")
    monkeypatch.setattr(demo, "POLICIES", {"flow": (bad, None)})
    monkeypatch.setattr(sys, "argv", ["demo.py", "--directory", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ended:
        run(demo.main)
    told = capsys.readouterr().err
    assert ended.value.code == 2
    assert told.startswith("error: ") and "Traceback" not in told
    assert "not-a-policy.ckpt" in told
    assert [*(tmp_path / "out").rglob("*")] == [tmp_path / "out" / "flow"]


@pytest.mark.slow
def test_a_folder_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    script = Path(__file__).parents[2] / "examples" / "pusht" / "demo.py"
    command = [sys.executable, str(script), "--directory", str(tmp_path / "file")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].startswith(("error: ", "Error: "))
    assert "Traceback" not in done.stderr
