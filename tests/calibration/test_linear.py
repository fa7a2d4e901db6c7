"""First-order predictions: exact where the policy is linear, and good enough to rank cells where it is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import linear
from ttscompile.calibration.calls import Actions, Calls, prepare_calls, sample_calls
from ttscompile.calibration.execute import Executor
from ttscompile.calibration.linear import LinearModel, linearise
from ttscompile.config import PolicySpec
from ttscompile.lattice import PlanArray, Source
from ttscompile.trajectories import load_trajectories


def prepared(directory: Path, recording: Path, count: int) -> tuple[Executor, PolicySpec, Calls]:
    artifact = load_artifact(directory)
    spec, executor = artifact.manifest.spec, Executor(artifact)
    episodes = load_trajectories([recording], spec.observations, 4)
    chosen = sample_calls(episodes, range(len(episodes)), count, seed=0)
    calls = prepare_calls(executor.model, spec, episodes, chosen, (0, 0))
    return executor, spec, calls.answered(executor.run_dense(calls))


def sparse_plan(executor: Executor, seed: int = 0) -> PlanArray:
    draw = np.random.default_rng(seed)
    shape = (executor.model.steps, executor.model.blocks)
    plan = np.where(draw.random(shape) < 0.2, Source.COMPUTE, Source.TIMESTEP).astype(np.int8)
    plan[0] = Source.COMPUTE
    return plan


def toggled(plan: PlanArray, k: int, b: int) -> PlanArray:
    other = plan.copy()
    other[k, b] = Source.TIMESTEP if plan[k, b] == Source.COMPUTE else Source.COMPUTE
    return other


def weighted_squares(actions: Actions, samples: torch.Tensor, calls: Calls) -> np.ndarray:
    """Squared error of each plan on each call, weighted as the model of the first plan weighs it."""
    differences = actions.executed(samples) - actions.executed(calls.targets)
    sizes = differences[0].abs()
    return (differences**2 / (sizes + linear.SOFTEN * sizes.median() + 1e-9)).sum(-1).numpy()


@pytest.fixture
def every_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many directions as the actions have, so that the projected error keeps all of the error."""
    monkeypatch.setattr(linear, "DIRECTIONS", 8)


@pytest.mark.usefixtures("every_direction")
def test_any_single_change_of_a_linear_policy_is_predicted_exactly(linear_policy: Path, recording: Path) -> None:
    executor, spec, calls = prepared(linear_policy, recording, 5)
    actions, plan = Actions(spec), sparse_plan(executor)
    model = linearise(executor, actions, plan, calls, seed=0)
    effects = model.toggles()
    cells = [(k, b) for k in range(1, executor.model.steps) for b in range(executor.model.blocks)]
    samples = executor.run([plan, *(toggled(plan, k, b) for k, b in cells)], calls)
    expected = weighted_squares(actions, samples, calls)[1:]
    found = ((model.error + np.stack([effects[k, b] for k, b in cells])) ** 2).reshape(len(cells), 5, 8).sum(-1)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-4)
    assert np.ptp(expected, axis=0).min() > 1  # else nothing was compared


@pytest.mark.usefixtures("every_direction")
def test_moving_a_computation_is_predicted_exactly_as_far_as_its_own_block(
    linear_policy: Path, recording: Path
) -> None:
    """The computed value is that of the rollout that was linearised, as nothing before it changes."""
    executor, spec, calls = prepared(linear_policy, recording, 3)
    actions = Actions(spec)
    plan = np.full((executor.model.steps, executor.model.blocks), Source.TIMESTEP, np.int8)
    plan[0] = Source.COMPUTE
    model = linearise(executor, actions, plan, calls, seed=0)
    moved = linearise(executor, actions, toggled(plan, 6, 2), calls, seed=0)
    difference = actions.executed(executor.run([toggled(plan, 6, 2), plan], calls))
    assert float((difference[0] - difference[1]).abs().max()) > 0.01  # else nothing was compared
    weighted = weighted_squares(actions, executor.run([plan, toggled(plan, 6, 2)], calls), calls)[1]
    predicted = ((model.error + model.toggles()[6, 2]) ** 2).reshape(3, -1).sum(-1)
    np.testing.assert_allclose(predicted, weighted, rtol=2e-3, atol=1e-4)
    assert moved.computed[6, 2]


@pytest.mark.usefixtures("every_direction")
def test_cells_of_a_nonlinear_policy_are_ranked(compiled: Path, recording: Path) -> None:
    executor, spec, calls = prepared(compiled, recording, 12)
    actions, plan = Actions(spec), sparse_plan(executor, 2)
    model = linearise(executor, actions, plan, calls, seed=0)
    predicted = ((model.error + model.toggles()) ** 2).sum(-1)[1:].flatten()
    cells = [(k, b) for k in range(1, executor.model.steps) for b in range(executor.model.blocks)]
    samples = executor.run([plan, *(toggled(plan, k, b) for k, b in cells)], calls)
    measured = weighted_squares(actions, samples, calls).sum(1)[1:]
    ranks = np.argsort(np.argsort(np.stack([predicted, measured]), axis=1), axis=1)
    assert np.corrcoef(ranks)[0, 1] > 0.8


def test_calls_are_linearised_alike_however_many_at_once(
    compiled: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor, spec, calls = prepared(compiled, recording, 5)
    together = linearise(executor, Actions(spec), sparse_plan(executor), calls, seed=0)
    monkeypatch.setattr(linear, "CANDIDATE_BYTES", 1)
    apart = linearise(executor, Actions(spec), sparse_plan(executor), calls, seed=0)
    np.testing.assert_allclose(apart.reach, together.reach, rtol=1e-3, atol=1e-4)
    np.testing.assert_array_equal(apart.error, together.error)


def test_each_residual_is_added_from_its_computation_to_the_next() -> None:
    """By hand: K = 4, one block; what is computed at o contributes 10 o + k at each step k >= o."""
    reach = np.zeros((1, 5, 4, 1), np.float32)
    for k in range(4):
        reach[0, k + 1, :, 0] = reach[0, k, :, 0] + 10 * np.arange(4) + k
    computed = np.array([[True], [False], [True], [False]])
    model = LinearModel(reach, np.array([100.0], np.float32), computed)
    toggles = model.toggles()[:, 0, 0]
    np.testing.assert_array_equal(toggles, [0, 10, -40, 10])  # 1: 11 for 1; 2: 2+3 for 22+23; 3: 33 for 23
    other = LinearModel(reach, model.error, np.array([[True], [True], [False], [False]]))
    assert other.toggles()[1, 0, 0] == 6 - (11 + 12 + 13)
