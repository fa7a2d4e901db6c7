"""What reuse can save at most."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ttscompile import SamplerTable
from ttscompile.artifact import load_artifact
from ttscompile.artifact.ceiling import few_steps, usual_sparsity
from ttscompile.artifact.manifest import FlopsRecord, Manifest
from ttscompile.core.lattice import dense_plan


@pytest.fixture
def flops() -> FlopsRecord:
    return FlopsRecord(dense=9999, prologue=20, pruner=5, stem=1, tail=2, blocks=(30, 70))


def with_steps(manifest: Manifest, flops: FlopsRecord, steps: int) -> Manifest:
    columns = dict.fromkeys(SamplerTable.COLUMNS, np.zeros(steps, np.float32))
    sampler = SamplerTable("ddim", np.arange(steps)[::-1].copy(), clip=None, **columns)
    return replace(manifest, flops=flops, spec=replace(manifest.spec, sampler=sampler))


def test_the_ceiling_is_a_dense_call_over_one_that_computes_step_0_alone(flops: FlopsRecord) -> None:
    assert flops.ceiling(10) == (20 + 10 * 3 + 10 * 100) / (20 + 10 * 3 + 100)
    least = dense_plan(10, 2)
    least[1:] = 2
    assert flops.ceiling(10) == flops.call(dense_plan(10, 2), False) / flops.call(least, False)
    assert flops.ceiling(1) == 1
    no_overhead = replace(flops, prologue=0, stem=0, tail=0)
    assert no_overhead.ceiling(10) == 10  # at most K


def test_five_steps_are_left_if_nobody_asks_for_fewer() -> None:
    assert [usual_sparsity(steps) for steps in (400, 100)] == [0.95] * 2
    assert [round(steps * (1 - usual_sparsity(steps))) for steps in (80, 50, 16, 10)] == [5] * 4
    assert [round(steps * (1 - usual_sparsity(steps))) for steps in (8, 7, 4, 2)] == [4, 3, 2, 1]


def test_few_steps_are_warned_about(written: Path, flops: FlopsRecord) -> None:
    manifest = load_artifact(written).manifest
    told = few_steps(with_steps(manifest, flops, 10))
    assert told is not None
    assert "K = 10 denoising steps" in told
    assert "at most 90.0% of the cells" in told
    assert "no plan has less than 14.3% of the FLOPs" in told
    assert few_steps(with_steps(manifest, flops, 19)) is not None
    assert few_steps(with_steps(manifest, flops, 20)) is None
