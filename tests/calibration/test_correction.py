"""Corrections that are fitted: exact where the policy is linear, better on calls that they were not fitted on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.calls import Actions, Calls, prepare_calls, sample_calls
from ttscompile.calibration.correction import anchors_of, fit_correction
from ttscompile.calibration.execute import Executor
from ttscompile.lattice import PlanArray, Source, uniform_plan
from ttscompile.trajectories import load_trajectories


def prepared(directory: Path, recording: Path, numbers: range, count: int) -> tuple[Executor, Actions, Calls]:
    artifact = load_artifact(directory)
    spec, executor = artifact.manifest.spec, Executor(artifact)
    episodes = load_trajectories([recording], spec.observations, 4)
    chosen = sample_calls(episodes, numbers, count, seed=0, repeats=100)
    calls = prepare_calls(executor.model, spec, episodes, chosen, (0, numbers.start))
    return executor, Actions(spec), calls.answered(executor.run_dense(calls))


def error(executor: Executor, actions: Actions, plan: PlanArray, calls: Calls) -> float:
    return float(actions.errors(executor.run([plan], calls)[0], calls.targets, units=False).mean())


@pytest.fixture
def plan(compiled: Path) -> PlanArray:
    manifest = load_artifact(compiled).manifest
    return uniform_plan(manifest.steps, len(manifest.blocks), 3)


def test_anchors_are_steps_that_compute_half_their_blocks() -> None:
    plan = np.full((4, 4), Source.TIMESTEP, np.int8)
    plan[0] = plan[2, :2] = plan[3, 0] = Source.COMPUTE
    assert anchors_of(plan).tolist() == [True, False, True, False]


def test_it_helps_on_calls_of_other_episodes(compiled: Path, recording: Path, plan: PlanArray) -> None:
    executor, actions, learned = prepared(compiled, recording, range(4), 400)
    _, _, held_out = prepared(compiled, recording, range(4, 6), 60)
    corrected = executor.corrected(fit_correction(executor, plan, learned))
    assert executor.correction is None
    assert error(corrected, actions, plan, held_out) < 0.5 * error(executor, actions, plan, held_out)


def test_a_linear_policy_is_corrected_to_its_own_noise(linear_policy: Path, recording: Path, plan: PlanArray) -> None:
    """Everything between anchors is linear in the features, but for how the observation enters: nearly exact."""
    executor, actions, calls = prepared(linear_policy, recording, range(6), 300)
    corrected = executor.corrected(fit_correction(executor, plan, calls, ridge=1e-9))
    assert error(corrected, actions, plan, calls) < 0.05 * error(executor, actions, plan, calls)


def test_a_dense_plan_needs_none(compiled: Path, recording: Path) -> None:
    executor, actions, calls = prepared(compiled, recording, range(6), 80)
    dense = np.zeros((executor.model.steps, executor.model.blocks), np.int8)
    correction = fit_correction(executor, dense, calls)
    assert np.abs(correction.weights).max() < 1e-3
    assert error(executor.corrected(correction), actions, dense, calls) < 1e-5


def test_the_reference_runtime_does_the_same(compiled: Path, recording: Path, plan: PlanArray) -> None:
    executor, _, calls = prepared(compiled, recording, range(6), 70)
    correction = fit_correction(executor, plan, calls)
    ours = executor.corrected(correction).run([plan], calls)[0]
    with torch.no_grad():
        theirs = executor.model.rollout(calls.contexts, calls.initial, calls.noise, plan, correction=correction)
    torch.testing.assert_close(ours, theirs.sample, rtol=0, atol=2e-5)


def test_the_same_calls_give_the_same_bytes(compiled: Path, recording: Path, plan: PlanArray) -> None:
    executor, _, calls = prepared(compiled, recording, range(6), 150)
    one, two = (fit_correction(executor, plan, calls) for _ in range(2))
    assert one.weights.tobytes() == two.weights.tobytes()
    assert one.bias.tobytes() == two.bias.tobytes()
