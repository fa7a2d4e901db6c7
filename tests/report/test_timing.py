"""Calls of plans whose loop draws noise in its steps, of a policy whose own loop draws none and is shorter."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.calibration import policies
from tests.once import Once
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.cli.contestants import Way, contestants
from ttscompile.core.lattice import dense_plan
from ttscompile.core.plan import Plan
from ttscompile.doctor.target import artifact_findings
from ttscompile.ir.program import Program
from ttscompile.report.facts import limits
from ttscompile.report.timing import measure_plans
from ttscompile.runtimes.random_calls import random_call
from ttscompile.samplers.flow import flow_matching_table


@pytest.fixture(scope="module")
def artifact(once: Once) -> Artifact:
    def convert(path: Path) -> Program:
        drawing = policies.spec()
        still = replace(flow_matching_table(4), timesteps=np.arange(4)[::-1].copy())
        spec = replace(drawing, sampler=still, loops={"drawing-10": drawing.sampler})
        program = ttscompile.compile_denoiser(policies.Mixer(0).eval(), spec, path)
        plans = {"dense": load_artifact(path).plans["dense"], "drawing": Plan("drawing-10", dense_plan(10, 6))}
        update_plans(path, plans, "drawing", {})
        return program

    return load_artifact(once.compiled("a loop that draws noise beside one that does not", convert)[0])


def test_noise_fits_every_loop_of_a_policy(artifact: Artifact) -> None:
    """As that of each loop alone, which takes the first steps."""
    spec = artifact.manifest.spec
    obs, noise = random_call(spec, 2, 7)
    assert noise.steps is not None and len(noise.steps) == 10
    for loop, draws in (("original", None), ("drawing-10", 10)):
        alone, own = random_call(spec.in_loop(loop), 2, 7)
        np.testing.assert_array_equal(own.initial, noise.initial)
        np.testing.assert_equal(alone, obs)
        assert (own.steps is None) is (draws is None)
        if own.steps is not None:
            np.testing.assert_array_equal(own.steps, noise.steps[:draws])


def test_such_a_plan_is_timed_tried_and_verified(artifact: Artifact) -> None:
    policy = ttscompile.load(artifact.path, seed=0)
    measured = measure_plans(policy, artifact.manifest.spec, ("dense", "drawing"), 1)
    assert [(one.plan, len(one.times_ms)) for one in measured] == [("dense", 1), ("drawing", 1)]
    entered = contestants({"": artifact}, (), [Way()])
    assert [one.plan for one in entered] == ["dense", "drawing"]
    for one in entered:
        one.call(*random_call(one.spec, 0, 0))
    (call,) = [one for one in artifact_findings(artifact.path) if one.what == "call"]
    assert "calls a second" in call.found
    rungs = {rung.name: rung for rung in ttscompile.verify(artifact.path).rungs}
    assert rungs["distance"].told == "there are no recorded episodes to measure it on"


def test_who_has_eight_bits_is_not_told_to_get_them(once: Once, tmp_path: Path) -> None:
    path, plain = shutil.copytree(policies.compiled(once, "int8"), tmp_path / "int8"), policies.compiled(once)
    plans = load_artifact(path).plans
    update_plans(path, {**plans, "exact": replace(plans["dense"], precision={})}, "exact", {})
    told = [" ".join(limits(load_artifact(one)).points) for one in (plain, path)]
    assert ["--precision int8 may be faster" in one for one in told] == [True, False]
