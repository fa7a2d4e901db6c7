"""Criteria that decide during a call, on onnxruntime: as calibration decides, and as a runtime executes it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import Calls, draw_noise
from ttscompile.calibration.runner import Runner
from ttscompile.core.lattice import Source
from ttscompile.core.plan import DENSE
from ttscompile.core.spec import Noise
from ttscompile.errors import IllegalPlanError
from ttscompile.rivals.deciding import Deciding
from ttscompile.rivals.online import Criterion, decide
from ttscompile.runtimes.open import open_runtime

from .rules import RULES

STREAMS = 6


@pytest.fixture(scope="module")
def artifact(compiled: Path) -> Artifact:
    return load_artifact(compiled)


@pytest.fixture(scope="module")
def obs(artifact: Artifact) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(7)
    spec = artifact.manifest.spec
    return {
        key: draw.standard_normal((STREAMS, *one.shape)).astype(np.float32) for key, one in spec.observations.items()
    }


@pytest.fixture(scope="module")
def noise(artifact: Artifact) -> Noise:
    initial, steps = draw_noise(artifact.manifest.spec, STREAMS, (8,))
    assert steps is not None
    return Noise(initial.numpy(), steps.numpy())


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_call_decides_as_calibration_does(
    artifact: Artifact, obs: dict[str, np.ndarray], noise: Noise, rule: Criterion
) -> None:
    runner = Runner(view_of(artifact, DENSE))
    contexts = runner.model.prologue({key: torch.from_numpy(one) for key, one in obs.items()})
    assert noise.steps is not None
    drawn = torch.from_numpy(noise.initial), torch.from_numpy(noise.steps)
    with Counted() as counted:
        expected = decide(runner, rule, Calls(contexts, *drawn, np.arange(STREAMS)))
    found, plans = Deciding(artifact, artifact.plans[DENSE], rule).predict(obs, noise)
    np.testing.assert_array_equal(plans, expected.plans)
    assert_equal_but_for_rounding(torch.from_numpy(found), expected.samples, counted.terms)
    assert len({plan.tobytes() for plan in plans}) > 1  # streams differ
    given = replace(artifact.plans[DENSE], cells=plans)
    again, report = open_runtime(artifact, plan=given).predict(obs, noise, given)
    assert_equal_but_for_rounding(torch.from_numpy(found), torch.from_numpy(again), counted.terms)
    np.testing.assert_array_equal(report.plan, plans)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_streams_do_not_influence_each_other(
    artifact: Artifact, obs: dict[str, np.ndarray], noise: Noise, rule: Criterion
) -> None:
    deciding = Deciding(artifact, artifact.plans[DENSE], rule)
    together, plans = deciding.predict(obs, noise)
    assert noise.steps is not None
    for i in (0, 4):
        one = Noise(noise.initial[i : i + 1], noise.steps[:, i : i + 1])
        alone, own = deciding.predict({key: value[i : i + 1] for key, value in obs.items()}, one)
        np.testing.assert_array_equal(own[0], plans[i])
        with Counted() as counted:
            torch.nn.functional.linear(torch.zeros(1, 64), torch.zeros(1, 64))
        assert_equal_but_for_rounding(torch.from_numpy(alone[0]), torch.from_numpy(together[i]), 100 * counted.terms)


def test_a_threshold_of_nothing_is_the_original(artifact: Artifact, obs: dict[str, np.ndarray], noise: Noise) -> None:
    dense = artifact.plans[DENSE]
    expected, _ = open_runtime(artifact, plan=dense).predict(obs, noise, dense)
    found, plans = Deciding(artifact, dense, replace(RULES[0], threshold=0.0)).predict(obs, noise)
    assert (plans == Source.COMPUTE).all()
    np.testing.assert_array_equal(found, expected)


def test_calls_leave_nothing_to_the_next_one(artifact: Artifact, obs: dict[str, np.ndarray], noise: Noise) -> None:
    deciding = Deciding(artifact, artifact.plans[DENSE], RULES[1])
    first, _ = deciding.predict(obs, noise)
    deciding.predict({key: one + 1 for key, one in obs.items()}, noise)
    deciding.forget_frames()
    np.testing.assert_array_equal(deciding.predict(obs, noise)[0], first)


def test_a_criterion_that_leaves_nothing_to_decide_is_refused_before_a_call(artifact: Artifact) -> None:
    with pytest.raises(IllegalPlanError, match="first 6 blocks at every step; the policy has 6"):
        Deciding(artifact, artifact.plans[DENSE], replace(RULES[1], always=6))
