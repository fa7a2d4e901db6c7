"""TaylorSeer as a correction: the forecasts of its formula, put in the place of what reuse predicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.calibration.tasks import MakeTask, found_by, make_task as task_on, row_of
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.calls import observed, sample_calls
from ttscompile.calibration.task import Task
from ttscompile.core.lattice import whole_steps_plan
from ttscompile.core.plan import Plan
from ttscompile.core.spec import Noise
from ttscompile.rivals.taylorseer import correction_for, forecast, schedules
from ttscompile.runtimes.open import open_runtime
from ttscompile.runtimes.random_calls import normalized
from ttscompile.trajectories import load_trajectories


def test_forecasts_by_hand() -> None:
    assert forecast(3, [0]) == (1.0, 0.0)  # a single step before: as it was
    assert forecast(5, [0, 2, 4]) == (1.5, -0.5)  # half of what two steps changed
    assert forecast(8, [0, 2, 4]) == (3.0, -2.0)
    newest, older = forecast(6, [1, 4])
    assert newest * 14 + older * 5 == pytest.approx(20)  # 5 at step 1, 14 at step 4: three a step


def test_schedules_begin_with_steps_in_a_row_and_go_on_evenly() -> None:
    assert schedules(10, 4) == {1: (0, 2, 5, 7), 2: (0, 1, 4, 7), 3: (0, 1, 2, 6)}
    assert schedules(10, 2) == {1: (0, 5)}
    assert schedules(10, 1) == {1: (0,)}
    assert schedules(4, 4) == {1: (0, 1, 2, 3), 2: (0, 1, 2, 3), 3: (0, 1, 2, 3)}


def forecast_loop(task: Task, steps: tuple[int, ...]) -> torch.Tensor:
    """The loop of the method, literally: at other steps than these the sampler is given the forecast."""
    runner, calls, known = task.runner, task.calls, dict[int, torch.Tensor]()
    model = runner.model
    carried = model.sampler.begin(calls.initial)

    def blocks(k: int, stream: torch.Tensor) -> torch.Tensor:
        for b in range(model.blocks):
            stream = stream + model.block(b, k, stream, calls.contexts)
        return stream

    with torch.no_grad():
        for k in range(model.steps):
            if k in steps:
                known[k] = prediction = model.predict(carried.sample, k, calls.contexts, blocks)
            else:
                before = [step for step in steps if step < k]
                newest, older = forecast(k, before)
                prediction = newest * known[before[-1]] + older * known[before[-2] if len(before) > 1 else 0]
            carried = model.sampler.advance(carried, prediction, None if calls.noise is None else calls.noise[k], k)
    return carried.sample


@pytest.mark.parametrize("steps", [(0, 1, 4, 7), (0, 5), (0,)])
def test_the_correction_is_the_method_where_nothing_is_clipped(
    linear_policy: Path, recording: Path, steps: tuple[int, ...]
) -> None:
    task = task_on(linear_policy, recording)
    model = task.runner.model
    with Counted() as counted:
        expected = forecast_loop(task, steps)
    run = task.runner.corrected(correction_for(task, steps))
    found = run.run(whole_steps_plan(model.steps, model.blocks, steps), task.calls)
    assert_equal_but_for_rounding(found, expected, 4 * counted.terms)  # what is taken out has been put in before
    plain = task.runner.run(whole_steps_plan(model.steps, model.blocks, steps), task.calls)
    assert (plain - expected).abs().max() > 100 * (found - expected).abs().max()


def test_the_best_warm_up_is_taken(make_task: MakeTask) -> None:
    task = make_task(budget=27)  # of 10 steps of 6 blocks: four whole steps, and three cells that are left over
    found = found_by("taylorseer", task)
    errors = {}
    for warmup, steps in schedules(10, 4).items():
        run = task.runner.corrected(correction_for(task, steps))
        samples = run.run(whole_steps_plan(10, 6, steps), task.calls)
        errors[warmup] = float(task.actions.errors(samples, task.calls.targets, units=False).mean())
    best = min(errors, key=errors.__getitem__)
    assert found.notes == {"steps": list(schedules(10, 4)[best]), "warmup": best}
    assert found.error == pytest.approx(errors[best], rel=1e-5)
    assert found.correction is not None
    assert np.flatnonzero(found.correction.anchors).tolist() == found.notes["steps"]
    assert not found.correction.bias.any()
    assert found.correction.reads == 0


def test_an_interrupted_search_has_its_correction(make_task: MakeTask) -> None:
    task = make_task(budget=24)
    search = row_of("taylorseer").search(task)
    search.advance(0)
    again = row_of("taylorseer").search(task)
    again.restore({name: value.copy() for name, value in search.state().items()})
    first, second = search.found().correction, again.found().correction
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.weights, second.weights)


def test_the_product_executes_it(linear_policy: Path, recording: Path) -> None:
    task, artifact, steps = task_on(linear_policy, recording), load_artifact(linear_policy), (0, 1, 4, 7)
    model, calls = task.runner.model, task.calls
    with Counted() as counted:
        expected = forecast_loop(task, steps)
    plan = Plan(cells=whole_steps_plan(model.steps, model.blocks, steps), correction=correction_for(task, steps))
    spec = artifact.manifest.spec
    episodes = load_trajectories([recording], spec.observations, 4)
    obs = normalized(spec, observed(spec, episodes, sample_calls(episodes, range(6), 12, 0, 100)))  # those of the task
    assert calls.noise is not None
    noise = Noise(calls.initial.numpy(), calls.noise.numpy())
    found, report = open_runtime(artifact, plan=plan).predict(obs, noise, plan)
    assert_equal_but_for_rounding(torch.from_numpy(found), expected, 4 * counted.terms)
    np.testing.assert_array_equal(report.plan[0], plan.cells)
