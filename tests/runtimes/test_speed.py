"""Times of the real policy, and of lowering a plan, recorded and not judged: `make benchmark` prints them."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

import ttscompile
from ttscompile.core.lattice import Source, uniform_plan
from ttscompile.runtimes.instructions import instructions_of
from ttscompile.runtimes.plans import LoweringCache

from .plans import random_plan

pytestmark = pytest.mark.alone

STEPS, GROUPS = 100, [0, 1, 2] * 8
OBSERVATION = np.random.default_rng(0).uniform(100, 400, (1, 2, 20)).astype(np.float32)


def test_load(benchmark: BenchmarkFixture, compiled_pusht: Path) -> None:
    policy = benchmark.pedantic(ttscompile.load, (compiled_pusht,), rounds=3, warmup_rounds=1)
    assert policy.info.K == 100


@pytest.mark.parametrize(("name", "rounds"), [("dense", 2), ("uniform 95 %", 10)])
def test_call(benchmark: BenchmarkFixture, compiled_pusht: Path, name: str, rounds: int) -> None:
    policy = ttscompile.load(compiled_pusht, seed=0)
    plan = "dense" if name == "dense" else uniform_plan(100, 24, 5)
    calls = {"plan": plan}
    out = benchmark.pedantic(policy.predict_action, ({"obs": OBSERVATION},), calls, rounds=rounds, warmup_rounds=1)
    report = policy.last_report
    assert report is not None
    assert report.computed == (2400 if name == "dense" else 120,)
    assert out["action"].shape == (1, 8, 2)


@pytest.mark.benchmark(group="lowering, K = 100, 24 blocks")
@pytest.mark.parametrize("kind", ["evenly spaced steps", "scattered, timestep only", "scattered, all sources"])
def test_lower_a_plan(benchmark: BenchmarkFixture, kind: str) -> None:
    rng = np.random.default_rng(0)
    plan = random_plan(rng, STEPS, GROUPS, np.ones((STEPS, 24), np.bool_), computed=0.05)
    if kind == "evenly spaced steps":
        plan = uniform_plan(STEPS, 24, 5)
    elif kind == "scattered, timestep only":
        plan = np.where(plan == Source.COMPUTE, Source.COMPUTE, Source.TIMESTEP).astype(np.int8)
    lowered = benchmark(instructions_of, plan, GROUPS)
    assert sum(lowered.counts) == np.count_nonzero(plan == Source.COMPUTE)


@pytest.mark.benchmark(group="lowering, K = 100, 24 blocks")
def test_lower_a_plan_again(benchmark: BenchmarkFixture) -> None:
    cache, plan = LoweringCache(partial(instructions_of, groups=GROUPS)), uniform_plan(STEPS, 24, 5)
    first = cache.lower(plan)
    assert benchmark(cache.lower, plan) is first
