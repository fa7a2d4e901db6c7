"""The executor of many plans means what the reference runtime means."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.calls import Calls, prepare_calls, sample_calls
from ttscompile.calibration.execute import Executor
from ttscompile.config import PolicySpec
from ttscompile.errors import IllegalPlanError
from ttscompile.lattice import Source, dense_plan
from ttscompile.trajectories import load_trajectories


def prepared(executor: Executor, spec: PolicySpec, recording: Path, count: int) -> Calls:
    episodes = load_trajectories([recording], spec.observations, 4)
    chosen = sample_calls(episodes, range(len(episodes)), count, seed=0)
    return prepare_calls(executor.model, spec, episodes, chosen, (0, 0))


def random_plans(count: int, steps: int, blocks: int, computed: float) -> np.ndarray:
    draw = np.random.default_rng(3)
    rest = (1 - computed) / 2
    plans = draw.choice(3, (count, steps, blocks), p=[computed, rest, rest]).astype(np.int8)
    plans[:, 0] = Source.COMPUTE
    return plans


@pytest.mark.parametrize("computed", [0.05, 0.5])
@pytest.mark.parametrize("streams", [1, 9, 256])
def test_plans_on_calls_equal_the_reference(compiled: Path, recording: Path, computed: float, streams: int) -> None:
    artifact = load_artifact(compiled)
    executor = Executor(artifact, streams)
    calls = prepared(executor, artifact.manifest.spec, recording, 3)
    plans = random_plans(12, executor.model.steps, executor.model.blocks, computed)
    plans[1] = Source.TIMESTEP  # nothing computed after step 0
    plans[1, 0] = Source.COMPUTE
    for plan, one in zip(plans, executor.run(plans, calls), strict=True):
        expected = executor.model.rollout(calls.contexts, calls.initial, calls.noise, plan).sample
        torch.testing.assert_close(one, expected, rtol=0, atol=2e-6)


def test_a_plan_for_each_call_equals_the_reference(compiled: Path, recording: Path) -> None:
    artifact = load_artifact(compiled)
    executor = Executor(artifact, 2)
    calls = prepared(executor, artifact.manifest.spec, recording, 5)
    plans = random_plans(5, executor.model.steps, executor.model.blocks, 0.3)
    expected = executor.model.rollout(calls.contexts, calls.initial, calls.noise, plans).sample
    torch.testing.assert_close(executor.run_each(plans, calls), expected, rtol=0, atol=2e-6)


def test_different_plans_have_different_results(compiled: Path, recording: Path) -> None:
    """Else the tests above would compare constants."""
    artifact = load_artifact(compiled)
    executor = Executor(artifact)
    calls = prepared(executor, artifact.manifest.spec, recording, 3)
    plans = random_plans(2, executor.model.steps, executor.model.blocks, 0.3)
    first, second = executor.run(plans, calls)
    assert (first - second).abs().max() > 1e-3
    assert (first[0] - first[1]).abs().max() > 1e-3


def test_calls_are_selected_in_the_order_given(compiled: Path, recording: Path) -> None:
    artifact = load_artifact(compiled)
    executor = Executor(artifact)
    calls = prepared(executor, artifact.manifest.spec, recording, 4)
    everything = executor.run_dense(calls)
    some = executor.run_dense(executor.selector.calls(calls, [2, 0, 2]))
    torch.testing.assert_close(some, everything[[2, 0, 2]], rtol=0, atol=2e-6)


def test_a_plan_that_needs_an_earlier_call_is_refused(compiled: Path, recording: Path) -> None:
    artifact = load_artifact(compiled)
    executor = Executor(artifact)
    calls = prepared(executor, artifact.manifest.spec, recording, 2)
    plan = dense_plan(executor.model.steps, executor.model.blocks)
    plan[3, 1] = Source.ROLLOUT
    with pytest.raises(IllegalPlanError, match="earlier call"):
        executor.run([plan], calls)
    with pytest.raises(IllegalPlanError, match="dense step 0"):
        executor.run([np.full_like(plan, Source.TIMESTEP)], calls)
