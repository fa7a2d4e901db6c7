"""What may be set, and what has to fit the policy."""

from dataclasses import fields, replace
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ttscompile
from ttscompile import ChunkSpec, ObservationSpec
from ttscompile.core.plan import Plan
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings, GuardLimits, settings

from .simulation import REAL_LIMIT, FakeClock, ScriptedPolicy, World


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ({"policy_hz": -1}, "policy_hz must be a number, positive"),
        ({"max_age": inf}, "max_age must be a number, positive and finite"),
        ({"policy_hz": "10"}, "policy_hz must be a number, positive and finite; found '10'"),
        ({"max_hold": -1}, "max_hold must be an integer of at least 0"),
        ({"rate_tolerance": "0.3"}, "rate_tolerance must be a number, between 0 and 0.5 periods; found '0.3'"),
        ({"rate_tolerance": 0.5}, "rate_tolerance must be a number, between 0 and 0.5 periods; found 0.5"),
        ({"max_age": True}, "max_age must be a number, positive and finite; found True"),
        ({"seam": "glue"}, "seam must be one of"),
        ({"interpolation": "cubic"}, "interpolation must be one of"),
        ({"tiers": ()}, "tiers must be a tuple of names"),
        ({"tiers": "fast"}, "each once; found 'fast'"),
        ({"tiers": ("a", "a")}, "each once"),
        ({"tiers": (Plan(), "a")}, r"tiers must be a tuple of names of plans, each once; found \(Plan"),
        ({"tiers": 5}, "each once; found 5"),
        ({"stall_after": 0}, "stall_after must be a number, positive and finite; found 0"),
        ({"stall_after": "2"}, "stall_after must be a number, positive and finite; found '2'"),
        ({"stall_range": -0.1}, "stall_range must be a number, positive and finite"),
        ({"stall_plan": None}, "stall_plan must be the name of a plan; found None"),
    ],
)
def test_settings_are_checked(made: dict[str, object], message: str) -> None:
    with pytest.raises(ExecutorError, match=message):
        ExecutorSettings(**made)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("made", "hz", "message"),
    [
        ({}, 0, "control_hz must be a number, positive"),
        ({}, inf, "control_hz must be a number, positive and finite"),
        ({}, "10", "control_hz must be a number, positive and finite; found '10'"),
        ({"policy_hz": 1e-320}, 10, "no multiple of policy_hz"),
        ({"policy_hz": 20}, 50, "no multiple of policy_hz = 20: an action would last 2.5 ticks"),
        ({"policy_hz": 20}, 10, "no multiple"),
        ({"horizon": 16}, 10, "Give at most 15"),
        ({"horizon": 10, "reserve": 6}, 10, "Give at most 5, or None"),
        ({"reserve": 8}, 10, "Give at most 7, or None"),
        ({"tiers": ("dense", "quick")}, 10, "no plan 'quick'; it has"),
        ({"stall_after": 1.0, "stall_plan": "slow"}, 10, "no plan 'slow'; it has .* Name tiers and stall_plan among"),
    ],
)
def test_settings_have_to_fit_the_policy(made: dict[str, object], hz: float, message: str) -> None:
    info = ScriptedPolicy(FakeClock(), reserve=7).info
    with pytest.raises(ExecutorError, match=message):
        settings.resolve(ExecutorSettings(**made), info, hz)  # type: ignore[arg-type]


def test_numbers_are_pythons_own() -> None:
    """In float32 a machine that has been up for eleven days has 16 ticks a second."""
    one, half = np.float32(1), np.float32(0.25)
    given = {"policy_hz": 50 * one, "max_age": half, "stall_after": one, "stall_range": half, "rate_tolerance": half}
    made = ExecutorSettings(**given, ensemble_coefficient=half)  # type: ignore[arg-type]
    policy = ScriptedPolicy(FakeClock(), {"dense": np.float32(0.015625)}, reserve=7)  # type: ignore[dict-item]
    policy.clock.advance(1e6)
    numbers = {each.name: getattr(made, each.name) for each in fields(made) if each.type in ("float", "float | None")}
    assert {name: type(number) for name, number in numbers.items()} == dict.fromkeys(
        [*given, "ensemble_coefficient"], float
    )
    hz: Any = 50 * one
    with World(hz, made, policy) as world:
        world.hz = 50.0
        assert world.executor.rates == (50.0, 50.0) and {type(rate) for rate in world.executor.rates} == {float}
        assert type(world.executor.feasibility()["dense"].latency) is float
        world.begin()
        actions = [tuple(world.tick()[1:]) for _ in range(100)]
    assert len(set(actions)) == len(actions)


def test_a_plan_of_ones_own_that_the_policy_was_loaded_with_is_run(toy_compiled: Path) -> None:
    """It has no name to call it by. Others of the artifact may be tiers beside it."""
    plans = ttscompile.load(toy_compiled).plans
    cells = np.array([[0] * 5, [2] * 5, [0] * 5, [2] * 5, [0] * 5], np.int8)
    policy = ttscompile.load(toy_compiled, seed=0, plan=replace(plans["dense"], cells=cells))
    guard = GuardLimits(low=-1e6, high=1e6)
    free = ExecutorSettings(guard=guard, refuse_infeasible=False, margin_ticks=0, warm_up=0, measured_calls=1)
    known = {"given": 0.01, "dense": 0.01}
    for tiers, name, latencies in (
        (None, "given", None),
        (("dense",), "dense", None),
        (("given", "dense"), "given", known),
    ):
        made = replace(free, tiers=tiers)
        with AsyncExecutor(policy, 20, made, latencies=latencies) as executor:
            executor.observe({"obs": np.zeros(2, np.float32)})
            executor.action(timeout=REAL_LIMIT)
            assert executor.statistics().plan == name
        report = policy.last_report
        assert report is not None and report.plan_name == name
    with pytest.raises(ExecutorError, match="the policy has no plan 'given'; it has"):
        AsyncExecutor(ttscompile.load(toy_compiled), 20, ExecutorSettings(tiers=("given",)))


def test_the_window_is_that_of_the_observations_wherever_the_chunk_begins() -> None:
    """A chunk that begins with the newest of two frames has start 0."""

    def steps(start: int, **frames: int | None) -> int:
        specs = {key: ObservationSpec((n or 1, 3), window=n is not None) for key, n in frames.items()}
        info = SimpleNamespace(
            observation=specs,
            action=ChunkSpec(2, start, start + 4),
            sample=(8, 2),
            plans=("dense",),
            default_plan="dense",
            policy_hz=None,
        )
        return settings.resolve(ExecutorSettings(), info, 10.0).frames.steps  # type: ignore[arg-type]

    assert steps(0, obs=2) == steps(0, obs=2, goal=None) == steps(1, obs=2) == 2
    assert steps(1, obs=3) == 3
    assert steps(1, obs=2, depth=4) == 2, "of two windows the one that the chunk implies"


def test_the_artifact_says_at_which_rate_its_actions_are_played() -> None:
    """Unless the settings do; and a loop that cannot play them at it is refused, not played faster."""
    info = replace(ScriptedPolicy(FakeClock()).info, policy_hz=10.0)
    assert settings.resolve(ExecutorSettings(), info, 50.0).ticks_per_step == 5
    assert settings.resolve(ExecutorSettings(policy_hz=25), info, 50.0).ticks_per_step == 2
    told = "no multiple of policy_hz = 10, at which its recordings were made: an action would last 2.5 ticks.*another"
    with pytest.raises(ExecutorError, match=told):
        settings.resolve(ExecutorSettings(), info, 25.0)
