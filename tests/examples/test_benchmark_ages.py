"""Corrections of criteria that decide during a call: fitted as a schedule's are, and what a call then answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import ages
import numpy as np
import pytest
import torch
from ages import fit_ages, fit_table

from tests.calibration.tasks import make_task
from tests.rivals.rules import RULES
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import Calls, draw_noise
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.sparse_loop import SparseLoop
from ttscompile.core.lattice import whole_steps_plan
from ttscompile.core.plan import DENSE
from ttscompile.core.spec import Noise
from ttscompile.errors import CalibrationError
from ttscompile.rivals.deciding import Deciding
from ttscompile.rivals.online import Criterion, decide

FITTED, OTHERS = 120, 6

NEVER = Criterion("teacache", 0, 1e9, (1.0, 0.0), accumulates=True, warmup=1, closes=True)
"""Computes the first and the last step."""

Made = Callable[[int, int], tuple[Calls, dict[str, np.ndarray], Noise]]
"""Of a number of calls and a seed: the calls with their dense paths, and what they were made of."""


@pytest.fixture(scope="module")
def artifact(compiled: Path) -> Artifact:
    return load_artifact(compiled)


@pytest.fixture(scope="module")
def runner(artifact: Artifact) -> Runner:
    return Runner(view_of(artifact, DENSE))


@pytest.fixture(scope="module")
def made(artifact: Artifact, runner: Runner) -> Made:
    spec = artifact.manifest.spec

    def calls(count: int, seed: int) -> tuple[Calls, dict[str, np.ndarray], Noise]:
        draw = np.random.default_rng(seed)
        obs = {
            key: draw.standard_normal((count, *one.shape)).astype(np.float32) for key, one in spec.observations.items()
        }
        initial, steps = draw_noise(spec, count, (seed,))
        contexts = runner.model.prologue({key: torch.from_numpy(one) for key, one in obs.items()})
        alone = Calls(contexts, initial, steps, np.arange(count) // 10)
        noise = Noise(initial.numpy(), None if steps is None else steps.numpy())
        return replace(alone, path=runner.run_dense(alone)), obs, noise

    return calls


@pytest.mark.parametrize("reads", [False, True])
def test_where_all_calls_decide_alike_they_are_those_of_the_schedule(runner: Runner, made: Made, reads: bool) -> None:
    fitted, others = made(FITTED, 1)[0], made(OTHERS, 2)[0]
    plan = whole_steps_plan(runner.model.steps, runner.model.blocks, (0, runner.model.steps - 1))
    with Counted() as counted:
        expected = SparseLoop(runner, fitted, others, reads=reads, whole=True).end(plan).samples
    _, found = fit_ages(runner, NEVER, fitted, others, reads)
    assert_equal_but_for_rounding(found, expected, 100 * counted.terms)


@pytest.mark.parametrize("reads", [False, True])
@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_call_answers_as_the_loop_in_which_they_were_fitted(
    artifact: Artifact, runner: Runner, made: Made, rule: Criterion, reads: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ages, "LEAST", 20)
    (fitted, *_), (others, obs, noise) = made(FITTED, 1), made(OTHERS, 2)
    with Counted() as counted:
        table, expected = fit_ages(runner, rule, fitted, others, reads)
    weights = np.stack([one.weights for one in table])
    assert len(table) > 1 and (weights[1:] != weights[0]).any()  # ages differ
    assert [bool(one.anchors.all()) for one in table] == [True] + [False] * (len(table) - 1)
    found, plans = Deciding(artifact, artifact.plans[DENSE], rule, table=table).predict(obs, noise)
    assert len({plan.tobytes() for plan in plans}) > 1  # and so do streams
    assert_equal_but_for_rounding(torch.from_numpy(found), expected, 100 * counted.terms)


def test_they_are_kept_where_they_are_better_on_other_episodes(compiled: Path, recording: Path) -> None:
    task = make_task(compiled, recording, calls=160)
    found = fit_table(task, NEVER)
    assert found.table and min(found.errors[1:]) < found.errors[0]
    whole = replace(NEVER, threshold=0.0)  # computes every step
    assert fit_table(task, whole).table == () and fit_table(task, whole).errors[0] < 1e-5
    assert decide(task.runner, whole, task.calls).cells.min() == 60
    alone = replace(task, calls=task.runner.select(task.calls, np.flatnonzero(task.calls.episodes == 1)))
    with pytest.raises(CalibrationError, match="record more than one"):
        fit_table(alone, NEVER)
