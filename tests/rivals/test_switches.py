"""Switches: found where the observation tells, and expressed exactly by the pruner's head."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.calibration.tasks import MakeTask
from ttscompile.artifact.load import load_artifact
from ttscompile.core.lattice import PlanArray, Source, whole_steps_plan
from ttscompile.ir.plan_head import has_head
from ttscompile.rivals.switches import Switch, capacity, fit_switches, head_features, head_weights
from ttscompile.runtimes.plans import pruner_plan

STEPS, BLOCKS, CALLS = 6, 4, 64


def planted(signal: bool) -> dict[str, np.ndarray]:
    """Exchanging (2, 1) for (4, 3) helps the calls whose first feature is positive, and hurts the others as much."""
    draw = np.random.default_rng(0)
    features = draw.standard_normal((CALLS, 10)).astype(np.float32)
    computed = np.zeros((STEPS, BLOCKS), np.bool_)
    computed[0] = computed[2] = True
    error = np.ones((CALLS, 2), np.float32)
    effects = np.zeros((STEPS, BLOCKS, CALLS, 2), np.float32)
    effects[1:] = 0.01 * draw.standard_normal((STEPS - 1, BLOCKS, CALLS, 2))
    sign = np.where(features[:, 0] > 0, -1, 1) if signal else np.ones(CALLS)
    effects[2, 1] += 0.1 * sign[:, None]
    effects[4, 3] += 0.1 * sign[:, None]
    return {
        "effects": effects,
        "error": error,
        "computed": computed,
        "features": features,
        "episodes": np.arange(CALLS) // 4,
    }


def test_a_planted_switch_is_found_with_its_condition() -> None:
    data = planted(signal=True)
    switch, *_ = fit_switches(**data, count=4)
    assert (switch.out, switch.into) == ((2, 1), (4, 3))
    on = data["features"] @ switch.weight + switch.bias > 0
    assert np.mean(on == (data["features"][:, 0] > 0)) > 0.8


def test_no_switch_where_every_exchange_hurts_whatever_the_observation() -> None:
    data = planted(signal=False)
    data["effects"] = np.abs(data["effects"])
    assert fit_switches(**data, count=4) == []


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_constant_features_give_no_switch(value: float) -> None:
    data = planted(signal=True)
    data["features"][:] = value
    assert fit_switches(**data, count=4) == []


def test_switches_do_not_get_into_each_others_way() -> None:
    draw = np.random.default_rng(1)
    data = planted(signal=True)
    sign = np.where(data["features"] > 0, -1, 1).astype(np.float32)
    for i in range(8):  # many exchanges that help
        k, b = draw.integers(1, STEPS), draw.integers(BLOCKS)
        data["effects"][k, b] += 0.3 * sign[:, i, None]
    switches = fit_switches(**data, count=8)
    assert len(switches) >= 2
    for i, one in enumerate(switches):
        for other in switches[i + 1 :]:
            assert not one.touched & {other.out, other.into}
            assert not other.touched & {one.out, one.into}


def switched(schedule: PlanArray, switches: list[Switch], on: np.ndarray) -> PlanArray:
    plan = schedule.copy()
    for switch, is_on in zip(switches, on, strict=True):
        if is_on:
            plan[switch.out], plan[switch.into] = Source.TIMESTEP, Source.COMPUTE
    return plan


def test_the_head_predicts_the_schedule_with_the_switches_that_are_on(make_task: MakeTask) -> None:
    task = make_task(calls=30)
    executor, calls, pruner = task.executor, task.calls, task.pruner
    assert has_head(pruner)
    assert executor.pruner_graph is not None
    features = head_features(executor.pruner_graph, calls)
    assert features.shape == (30, 32)
    schedule = whole_steps_plan(10, 6, [0, 5])
    schedule[7, 2] = Source.FORWARD
    draw = np.random.default_rng(0)
    directions = draw.standard_normal((3, features.shape[1]))
    biases = -np.median(features @ directions.T, axis=0) + 1e-3
    switches = [
        Switch((5, 0), (6, 1), directions[0], float(biases[0])),
        Switch((5, 2), (5 + 3, 3), directions[1], float(biases[1])),
        Switch((5, 4), (9, 5), directions[2], float(biases[2])),
    ]
    weights = head_weights(pruner, schedule, switches, features)
    found = pruner_plan(executor.logits(calls, weights))
    on = features @ directions.T + biases > 0
    assert on.any(0).all()
    assert not on.all(0).any()
    for plan, states in zip(found, on, strict=True):
        np.testing.assert_array_equal(plan, switched(schedule, switches, states))
    assert {name: w.shape for name, w in weights.items()} == {name: w.shape for name, w in pruner.items()}


def test_a_switch_within_one_step(make_task: MakeTask) -> None:
    task = make_task(calls=2)
    assert task.executor.pruner_graph is not None
    features = head_features(task.executor.pruner_graph, task.calls)
    schedule = whole_steps_plan(10, 6, [0])
    schedule[3, 0] = Source.COMPUTE
    for bias, computed in ((1.0, 4), (-1.0, 0)):
        switch = Switch((3, 0), (3, 4), np.zeros(features.shape[1]), bias)
        weights = head_weights(task.pruner, schedule, [switch], features)
        for plan in pruner_plan(task.executor.logits(task.calls, weights)):
            assert np.flatnonzero(plan[3] == Source.COMPUTE).tolist() == [computed]


def test_the_capacity_is_what_the_head_has_room_for(compiled: Path) -> None:
    assert capacity(load_artifact(compiled).pruner) == 16
    assert not has_head({"pruner.weight": torch.zeros(1)})
