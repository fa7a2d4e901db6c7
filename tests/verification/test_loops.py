"""The golden record of a policy of several loops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.passes.loops import LOOPS, module_of, program_of, spec
from ttscompile import Plan
from ttscompile.artifact import load_artifact
from ttscompile.artifact.golden import DIGITS, Golden, load_golden
from ttscompile.artifact.load import Artifact
from ttscompile.artifact.write import update_plans, write_artifact
from ttscompile.core.lattice import whole_steps_plan
from ttscompile.driver import transform
from ttscompile.errors import ArtifactError
from ttscompile.lower.program import lower_program
from ttscompile.verification.record_golden import record_original
from ttscompile.verification.reuse import check_engaged
from ttscompile.verification.rung import PASSED

from .timed import Timed

pytestmark = pytest.mark.slow


@cache
def record(kind: str, loop: str | None = None) -> Golden:
    return record_original(module_of(kind), program_of(kind, loop))


@pytest.mark.parametrize("kind", ["tokens", pytest.param("skip", marks=pytest.mark.soak)])
def test_the_originals_record_is_that_of_a_policy_without_further_loops(kind: str) -> None:
    """Array by array; and what is of another loop has its name before it."""
    found, expected = record(kind).arrays(), record(kind, "original").arrays()
    assert not any(name.startswith("loop/") for name in expected)
    assert {name.split("/")[1] for name in found.keys() - expected.keys()} == set(LOOPS)
    assert all(name.startswith("loop/") for name in found.keys() - expected.keys())
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize("kind", ["tokens", pytest.param("skip", marks=pytest.mark.soak)])
def test_a_loops_record_is_of_the_same_call_in_that_loop(kind: str) -> None:
    """As the policy of that loop alone has it; but residuals, which have the original's scales."""
    whole = record(kind)
    found, expected = whole.in_loop("ddim-3"), record(kind, "ddim-3")
    assert found.loops == {} and list(whole.loops) == list(LOOPS)
    np.testing.assert_array_equal(found.scales, whole.scales)
    assert not np.array_equal(found.scales, expected.scales)
    same = ("initial", "steps", "evaluated", "inputs", "outputs", "predictions", "path", "sample", "executed")
    for name in same:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.predictions.shape == (3, 2, DIGITS) and found.draws is None
    assert found.residuals.shape == (3, len(program_of(kind).blocks), 2, DIGITS)
    # Timesteps of the loop: those of the original are others.
    assert not np.array_equal(found.residuals[1], whole.residuals[1])
    assert not np.array_equal(found.sample, whole.sample)


def test_each_stochastic_loop_has_draws_of_its_own() -> None:
    whole = record("tokens")
    other = whole.in_loop("ddpm-4")
    assert whole.draws is not None and other.draws is not None
    assert (whole.draws.shape, other.draws.shape) == ((6, 2, 4, 2), (4, 2, 4, 2))
    assert not np.isin(other.draws, whole.draws).any()
    own = {name for name in whole.arrays() if name.startswith("loop/ddpm-4/")}
    assert own == {
        f"loop/ddpm-4/{name}"
        for name in (
            "draws", "steps", "residuals", "evaluated", "inputs", "outputs", "predictions", "path", "sample",
            "actions", "executed",
        )
    }  # fmt: skip


@pytest.fixture(scope="module")
def artifact(tmp_path_factory: pytest.TempPathFactory) -> Artifact:
    """With a further loop whose models are the original's."""
    folder = tmp_path_factory.mktemp("loops") / "artifact"
    module = module_of("tokens")
    program = transform(module, replace(spec(), loops={"ddim-6-trailing": LOOPS["ddim-6-trailing"]}))
    write_artifact(program, lower_program(program), folder, golden=record_original(module, program))
    return load_artifact(folder)


def test_a_record_comes_back(artifact: Artifact) -> None:
    found = load_golden(artifact)
    assert list(found.loops) == ["ddim-6-trailing"]
    expected = record("tokens")
    for one, other in ((found, expected), (found.loops["ddim-6-trailing"], expected.loops["ddim-6-trailing"])):
        mine, its = (each.in_loop("original").arrays() for each in (one, other))
        assert mine.keys() == its.keys()
        for name, array in its.items():
            np.testing.assert_array_equal(mine[name], array)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("loop/ddim-6-trailing/path"), "loop/ddim-6-trailing/path"),
        (lambda a: a.update({"loop/ddim-4/path": a["path"]}), "loop/ddim-4/path"),
        (lambda a: a.update({"loop/ddim-6-trailing/steps": np.arange(1, 7)}), "steps of 0..5 of the loop ddim-6-trail"),
        (lambda a: a.update({"evaluated": np.arange(1, 7)}), "steps of 0..5 of the loop original"),
    ],
)
def test_a_record_that_does_not_fit_is_refused(
    artifact: Artifact, change: Callable[[dict[str, np.ndarray]], object], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = load_golden(artifact).arrays()
    change(arrays)
    monkeypatch.setattr("ttscompile.artifact.tensors.read", lambda path: arrays)
    with pytest.raises(ArtifactError, match=message):
        load_golden(artifact)


def test_a_plan_that_draws_noise_is_timed_where_the_original_draws_none(tmp_path: Path) -> None:
    module = module_of("tokens")
    loops = {name: LOOPS[name] for name in ("ddpm-4", "ddim-3")}
    program = transform(module, replace(spec(), sampler=loops.pop("ddim-3"), loops=loops))
    write_artifact(program, lower_program(program), tmp_path, golden=record_original(module, program))
    fast = Plan("ddpm-4", whole_steps_plan(4, len(program.blocks), [0]))
    update_plans(tmp_path, {"dense": load_artifact(tmp_path).plans["dense"], "fast": fast}, "fast")
    artifact, policy = load_artifact(tmp_path), Timed(ttscompile.load(tmp_path), {"dense": 1.0, "fast": 0.25}, 0.0)
    rung = check_engaged(artifact, load_golden(artifact), policy, lambda: policy.now)  # type: ignore[arg-type]
    assert rung.status == PASSED and rung.details["fast"]["executed"] == 0.75
