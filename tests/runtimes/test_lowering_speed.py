"""How long lowering takes at the size of the Push-T policy; recorded, not asserted."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from ttscompile.core.lattice import Source, uniform_plan
from ttscompile.runtimes.instructions import instructions_of
from ttscompile.runtimes.plans import LoweringCache

from .plans import random_plan

pytestmark = pytest.mark.alone

STEPS, GROUPS = 100, [0, 1, 2] * 8


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
