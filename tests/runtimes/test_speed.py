"""Times of the real policy, recorded and not judged: `make benchmark` prints them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

import ttscompile
from ttscompile.core.lattice import uniform_plan

pytestmark = pytest.mark.alone

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
