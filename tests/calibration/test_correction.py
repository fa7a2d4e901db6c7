"""Corrections that are fitted: exact where the policy is linear, better on calls that they were not fitted on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import fit_correction as fitting
from ttscompile.calibration.fit_correction import anchors_of, fit_correction
from ttscompile.calibration.strategies import Task
from ttscompile.core.lattice import PlanArray, Source, dense_plan, uniform_plan

from . import tasks
from .tasks import MakeTask


@pytest.fixture
def plan(compiled: Path) -> PlanArray:
    manifest = load_artifact(compiled).manifest
    return uniform_plan(manifest.steps, len(manifest.blocks), 3)


def test_anchors_are_steps_that_compute_half_their_blocks() -> None:
    plan = np.full((4, 4), Source.TIMESTEP, np.int8)
    plan[0] = plan[2, :2] = plan[3, 0] = Source.COMPUTE
    assert anchors_of(plan).tolist() == [True, False, True, False]


def fitted(task: Task, plan: PlanArray) -> Task:
    """The same with the correction of a plan, fitted on all of its calls."""
    return replace(task, executor=task.executor.corrected(fit_correction(task.executor, plan, task.calls)))


def test_it_helps_on_calls_of_other_episodes(make_task: MakeTask, plan: PlanArray) -> None:
    task, held_out = make_task(calls=400, episodes=range(4)), make_task(calls=60, episodes=range(4, 6)).calls
    corrected = fitted(task, plan)
    assert task.executor.correction is None
    assert corrected.error(plan, held_out) < 0.5 * task.error(plan, held_out)


def test_a_linear_policy_is_corrected_to_its_own_noise(
    linear_policy: Path, recording: Path, plan: PlanArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything between anchors is linear in the features, but for how the observation enters: nearly exact."""
    monkeypatch.setattr(fitting, "RIDGE", 1e-9)
    task = tasks.make_task(linear_policy, recording, calls=300)
    assert fitted(task, plan).error(plan, task.calls) < 0.05 * task.error(plan, task.calls)


def test_a_dense_plan_needs_none(make_task: MakeTask) -> None:
    task = make_task(calls=80)
    dense = dense_plan(task.executor.model.steps, task.executor.model.blocks)
    corrected = fitted(task, dense)
    assert corrected.executor.correction is not None
    assert np.abs(corrected.executor.correction.weights).max() < 1e-3
    assert corrected.error(dense, task.calls) < 1e-5


def test_the_reference_runtime_does_the_same(make_task: MakeTask, plan: PlanArray) -> None:
    task = make_task(calls=70)
    executor, calls = fitted(task, plan).executor, task.calls
    ours = executor.run(plan, calls)
    with torch.no_grad():
        theirs = executor.model.denoise(
            calls.contexts, calls.initial, calls.noise, plan, correction=executor.correction
        )
    torch.testing.assert_close(ours, theirs.sample, rtol=0, atol=2e-5)


def test_the_same_calls_give_the_same_bytes(make_task: MakeTask, plan: PlanArray) -> None:
    task = make_task(calls=150)
    one, two = (fit_correction(task.executor, plan, task.calls) for _ in range(2))
    assert one.weights.tobytes() == two.weights.tobytes()
    assert one.bias.tobytes() == two.bias.tobytes()
