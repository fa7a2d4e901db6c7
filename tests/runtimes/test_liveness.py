"""Which entries of the rollout cache are kept."""

from dataclasses import replace

import numpy as np
import pytest

from tests.plans import store_schedules
from tests.rounding import assert_equal_but_for_rounding
from ttscompile import Source
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import ORIGINAL, Plan
from ttscompile.errors import IllegalPlanError
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.liveness import readable_rollout, reads_earlier_calls, rollout_needs
from ttscompile.runtimes.load import load

from .agreement import assert_alike, call_terms, random_inputs
from .buffers import rollout_nbytes

C, T, R = Source.COMPUTE, Source.TIMESTEP, Source.ROLLOUT
ENTRY = 3 * 4 * 4


@pytest.fixture
def scheduled(own_artifact: Artifact) -> Artifact:
    """A toy with two schedules; one of them reads two rollout entries."""
    reads = uniform_plan(5, 5, 2)
    reads[2, 1] = reads[3, 4] = R
    schedules = {"plain": uniform_plan(5, 5, 2), "reads": reads}
    store_schedules(own_artifact.path, None, schedules, "plain", {})
    return load_artifact(own_artifact.path)


def test_schedules_say_exactly_what_they_read(scheduled: Artifact, toy_artifact: Artifact) -> None:
    assert np.argwhere(readable_rollout(view_of(scheduled))).tolist() == [[2, 1], [3, 4]]
    view = view_of(scheduled)
    assert {name for name, plan in view.plans.items() if reads_earlier_calls(view, plan)} == {"reads"}
    needs = load(scheduled.path).info.rollout
    assert (needs.read, needs.bytes_read, needs.cells, needs.bytes_most) == (2, 2 * ENTRY, 25, 25 * ENTRY)
    assert rollout_needs(view_of(toy_artifact)).read == 0  # its pruner is no plan of it


def head(**changes: float) -> dict[str, np.ndarray]:
    """A pruner that can choose ROLLOUT nowhere: COMPUTE leads by 4, and the code moves a logit by at most 2 x 1."""
    base = np.zeros((5, 5, 4), np.float32)
    base[..., C] = 4
    mask = np.zeros_like(base)
    mask[0, :, 1:] = -1e9
    step, block = np.ones((5, 2), np.float32), np.zeros((2, 5 * 4), np.float32)
    block.reshape(2, 5, 4)[..., R] = changes.get("swing", 1.0)
    base[3, 2, R] = changes.get("lead", 0.0)
    return {"pruner.base": base, "pruner.mask": mask, "pruner.step": step, "pruner.block": block}


@pytest.mark.parametrize(
    ("changes", "cells"),
    [
        ({}, []),
        ({"lead": 1.9}, []),
        ({"lead": 2.1}, [[3, 2]]),
        ({"swing": 2.1}, [[k, b] for k in range(1, 5) for b in range(5)]),
    ],
)
def test_a_pruner_is_known_by_the_bounds_of_its_logits(
    own_artifact: Artifact, changes: dict[str, float], cells: list[list[int]]
) -> None:
    store_schedules(own_artifact.path, dict(own_artifact.pruner), {}, "tts", {})
    artifact = load_artifact(own_artifact.path)
    assert readable_rollout(view_of(artifact)).all()  # the toy's own pruner is of another form
    changed = replace(artifact, pruners={ORIGINAL: head(**changes)})
    assert np.argwhere(readable_rollout(view_of(changed))).tolist() == cells
    view = view_of(changed)
    assert {name for name, plan in view.plans.items() if reads_earlier_calls(view, plan)} == (
        {"tts"} if cells else set()
    )


def test_calls_with_the_artifacts_plans_keep_what_these_read(scheduled: Artifact) -> None:
    runtime, reference = open_runtime(scheduled), open_runtime(scheduled, "reference")
    rng = np.random.default_rng(0)
    assert rollout_nbytes(runtime) == 2 * ENTRY
    for name in ("plain", "reads", "dense", "plain", "reads"):
        obs, noise = random_inputs(scheduled, rng, 1)
        found, report = runtime.predict(obs, noise, scheduled.plans[name])
        expected, wanted = reference.predict(obs, noise, scheduled.plans[name])
        assert_equal_but_for_rounding(found, expected, call_terms(scheduled))
        assert report.legalised == wanted.legalised
        if name == "plain":
            kept = rollout_nbytes(runtime)
            assert kept in (2 * ENTRY, 25 * ENTRY)
    assert report.legalised == (0,)
    assert rollout_nbytes(runtime) == 25 * ENTRY  # the dense call kept all


def test_a_matrix_may_read_what_dense_calls_and_matrices_computed(scheduled: Artifact) -> None:
    runtime = open_runtime(scheduled)
    obs, noise = random_inputs(scheduled, np.random.default_rng(0), 1)
    reads = uniform_plan(5, 5, 2)
    reads[1] = R
    runtime.predict(obs, noise, scheduled.plans["dense"])
    runtime.predict(obs, noise, Plan(cells=reads))
    runtime.reset()
    with pytest.raises(IllegalPlanError, match="step 1, block 0 .*never computed"):
        runtime.predict(obs, noise, Plan(cells=reads))


def test_a_matrix_reads_no_older_residual_than_the_last_computed(scheduled: Artifact) -> None:
    """A dense call keeps all; a plan of the artifact then computes cells anew, and does not keep them."""
    runtime, reference = open_runtime(scheduled), open_runtime(scheduled, "reference")
    rng = np.random.default_rng(0)
    plain = scheduled.plans["plain"].cells
    assert plain is not None
    for name in ("dense", "plain"):
        obs, noise = random_inputs(scheduled, rng, 1)
        for each in (runtime, reference):
            each.predict(obs, noise, scheduled.plans[name])
    (k,) = np.flatnonzero((plain == C).all(axis=1))[1:]
    row = np.arange(5)[:, None] == k
    gone, there = np.where(row, R, plain), np.where(row, T, np.where(plain == T, R, plain))
    with pytest.raises(IllegalPlanError, match=rf"step {k}, block 0, .* did not keep"):
        runtime.predict(obs, noise, Plan(cells=gone))
    with pytest.raises(IllegalPlanError, match=rf"step {k}, block 0, .* did not keep"):  # nor is that repaired
        runtime.predict(obs, noise, replace(scheduled.plans["plain"], cells=gone))
    assert_alike(scheduled, (runtime, reference), Plan(cells=there), rng)
    with pytest.raises(IllegalPlanError, match=rf"step {k}, block 0, .* did not keep"):  # that call computed none of it
        runtime.predict(obs, noise, Plan(cells=gone))


def test_a_first_matrix_after_a_plan_of_the_artifact_is_told_what_was_not_kept(scheduled: Artifact) -> None:
    runtime = open_runtime(scheduled)
    obs, noise = random_inputs(scheduled, np.random.default_rng(0), 1)
    plain = scheduled.plans["plain"].cells
    assert plain is not None
    (k,) = np.flatnonzero((plain == C).all(axis=1))[1:]
    reads = plain.copy()
    reads[k] = R
    runtime.predict(obs, noise, scheduled.plans["plain"])
    with pytest.raises(IllegalPlanError, match=rf"step {k}, block 0, .* did not keep.*Begin the episode with"):
        runtime.predict(obs, noise, Plan(cells=reads))
    runtime.predict(obs, noise, Plan(cells=plain))  # a matrix: from here on all is kept, whatever the plan
    runtime.reset()
    runtime.predict(obs, noise, scheduled.plans["plain"])
    assert runtime.predict(obs, noise, Plan(cells=reads))[1].legalised == (0,)
