"""Corrections in all runtimes, and which plans get them."""

import gc
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.plans import store_schedules
from tests.runtimes.plans import random_correction
from ttscompile import Noise
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.core.correction import Correction, no_correction
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.errors import IllegalPlanError
from ttscompile.runtimes import open_runtime

from .agreement import corrected_episode, random_inputs


@pytest.mark.parametrize("streams", [1, 3])
def test_runtimes_agree_on_random_corrections(toy_artifact: Artifact, streams: int) -> None:
    rng = np.random.default_rng(streams)
    corrections = [random_correction(toy_artifact, rng) for _ in range(4)]
    assert len(list(corrected_episode(toy_artifact, rng, streams, corrections, [None] * 4))) == 4
    assert any(len(one.jumps) for one in corrections)


@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_what_it_reads_of_the_observation_is_each_streams_own(toy_artifact: Artifact, runtime: str) -> None:
    """Every step adds what the observation says; with another observation in one stream the others stay."""
    rng, made = np.random.default_rng(0), open_runtime(toy_artifact, runtime)
    correction = random_correction(toy_artifact, rng)
    assert correction.reads > 0
    plan = uniform_plan(toy_artifact.manifest.steps, len(toy_artifact.manifest.groups), 2)
    obs, noise = random_inputs(toy_artifact, rng, 3)

    def call(given: dict[str, np.ndarray], one: Correction) -> np.ndarray:
        made.reset()
        return made.predict(given, noise, Plan(cells=plan, correction=one))[0]

    blind = replace(correction, observed=np.zeros_like(correction.observed))
    assert (np.abs(call(obs, correction) - call(obs, blind)).max(axis=(1, 2)) > 1e-2).all()
    turned = {key: np.concatenate([-value[:1], value[1:]]) for key, value in obs.items()}
    changed = np.abs(call(turned, correction) - call(obs, correction)).max(axis=(1, 2))
    assert changed[0] > 1e-2
    assert (changed[1:] < 1e-5).all()


@pytest.fixture
def corrected(own_artifact: Artifact) -> tuple[Path, Correction, np.ndarray]:
    manifest = own_artifact.manifest
    correction = random_correction(own_artifact, np.random.default_rng(0))
    plan = uniform_plan(manifest.steps, len(manifest.groups), 2)
    store_schedules(own_artifact.path, None, {"fast": plan, "bare": plan}, "fast", {}, corrections={"fast": correction})
    return own_artifact.path, correction, plan


@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_it_belongs_to_the_plan_of_its_name(corrected: tuple[Path, Correction, np.ndarray], runtime: str) -> None:
    path, correction, plan = corrected
    artifact = load_artifact(path)
    corrections = {name: plan.correction for name, plan in artifact.plans.items() if plan.correction is not None}
    assert set(corrections) == {"fast"}
    np.testing.assert_array_equal(corrections["fast"].weights, correction.weights)
    obs, noise = random_inputs(artifact, np.random.default_rng(1), 1)
    policy = ttscompile.load(path, runtime=runtime)

    def call(**options: Any) -> np.ndarray:
        policy.reset()
        return np.asarray(policy.predict_action(obs, noise=Noise(noise.initial, noise.steps), **options)["action_pred"])

    by_default, named, bare, matrix = call(), call(plan="fast"), call(plan="bare"), call(plan=plan)
    np.testing.assert_array_equal(by_default, named)
    np.testing.assert_array_equal(bare, matrix)
    assert np.abs(named - bare).max() > 1e-2
    dense = call(plan="dense")
    assert np.abs(dense - named).max() > 1e-3


def test_a_matrix_has_none_whatever_plans_are_called(corrected: tuple[Path, Correction, np.ndarray]) -> None:
    path, correction, plan = corrected
    store_schedules(path, None, {"given": plan, "bare": plan}, "given", {}, corrections={"given": correction})
    policy = ttscompile.load(path)
    obs, noise = random_inputs(load_artifact(path), np.random.default_rng(1), 1)
    named, bare, matrix = (policy.predict_action(obs, noise, each)["action"] for each in ("given", "bare", plan))
    np.testing.assert_array_equal(bare, matrix)
    assert np.abs(named - bare).max() > 1e-2


def test_the_first_call_binds_nothing(
    corrected: tuple[Path, Correction, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    artifact = load_artifact(corrected[0])
    runtime = open_runtime(artifact, "onnxruntime")
    obs, noise = random_inputs(artifact, np.random.default_rng(1), 1)
    made: list[object] = []
    monkeypatch.setattr("ttscompile.runtimes.onnxruntime.workspace.Bound", lambda *arguments: made.append(arguments))
    fast = artifact.plans["fast"]
    runtime.predict(obs, noise, fast)
    assert made == []
    assert fast.correction is not None
    another = replace(fast.correction)
    with pytest.raises(AttributeError):  # what stands in for a binding cannot run
        runtime.predict(obs, noise, replace(fast, correction=another))
    assert len(made) == artifact.manifest.steps


@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_one_of_another_size_is_refused_and_the_episode_goes_on(
    corrected: tuple[Path, Correction, np.ndarray], runtime: str
) -> None:
    artifact = load_artifact(corrected[0])
    steps, (horizon, dimensions) = artifact.manifest.steps, artifact.manifest.spec.sample
    opened = open_runtime(artifact, runtime)
    obs, noise = random_inputs(artifact, np.random.default_rng(1), 1)
    opened.predict(obs, noise, artifact.plans["dense"])
    for k, size in ((steps - 1, (horizon, dimensions)), (steps + 1, (horizon, dimensions)), (steps, (horizon - 1, 2))):
        with pytest.raises(IllegalPlanError, match=f"the correction has weights .* this policy needs .{steps}, "):
            opened.predict(obs, noise, replace(artifact.plans["dense"], correction=no_correction(k, size)))
    assert opened.streams == 1


def test_corrections_without_end_do_not_fill_the_memory(
    corrected: tuple[Path, Correction, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ttscompile.runtimes.onnxruntime.workspace.KEPT_CORRECTIONS", 3)
    artifact = load_artifact(corrected[0])
    runtime = open_runtime(artifact, "onnxruntime")
    obs, noise = random_inputs(artifact, np.random.default_rng(1), 1)
    fast = artifact.plans["fast"]
    assert fast.correction is not None
    found, kept = [], list[weakref.ref[Correction]]()
    for _ in range(6):
        plan = replace(fast, correction=replace(fast.correction))
        assert plan.correction is not None
        kept.append(weakref.ref(plan.correction))
        found.append(runtime.predict(obs, noise, plan)[0])
        runtime.reset()
    del plan
    gc.collect()
    assert sum(one() is not None for one in kept) <= 4
    assert all(np.array_equal(one, found[0]) for one in found)


def test_it_is_part_of_the_identity(corrected: tuple[Path, Correction, np.ndarray]) -> None:
    path, _, plan = corrected
    before = load_artifact(path).manifest
    store_schedules(path, None, {"fast": plan, "bare": plan}, "fast", {})
    after = load_artifact(path).manifest
    assert before.identity != after.identity
    assert before.model_identity == after.model_identity


def test_one_that_does_not_fit_is_not_written(corrected: tuple[Path, Correction, np.ndarray]) -> None:
    path, _, plan = corrected
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    with pytest.raises(IllegalPlanError, match="this policy needs"):
        store_schedules(path, None, {"fast": plan}, "fast", {}, corrections={"fast": no_correction(3, (2, 2))})
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before
