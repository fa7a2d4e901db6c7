"""Calls far outside of what was recorded: the same in all runtimes, in a module, exported, and in the single file."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.lower.whole_call import Episode
from tests.plans import store_schedules
from tests.rounding import assert_equal_but_for_rounding
from ttscompile import Noise
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.corrections import envelope_arrays, read_envelope
from ttscompile.artifact.write import write_artifact
from ttscompile.core.envelope import FAR, Envelope, plain_cells
from ttscompile.core.plan import Plan
from ttscompile.errors import ArtifactError, IllegalPlanError
from ttscompile.lower.program import lower_program
from ttscompile.lower.single_file import lower_single_file
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.single_file import inputs_of

from .agreement import call_terms, random_inputs
from .plans import random_correction, random_plan
from .pruners import random_pruner
from .toys import toy_program

STEPS, BLOCKS = 4, 3

NEAR, OUTSIDE = 1.4, 1.6
"""Distances of two observations, on either side of ``FAR``."""


def conditions(artifact: Artifact, obs: dict[str, np.ndarray], noise: Noise) -> np.ndarray:
    runtime = open_runtime(artifact, "reference")
    runtime.predict(obs, noise, artifact.plans["dense"])
    return runtime.backend.condition()


def between(condition: np.ndarray) -> Envelope:
    """In which the first two of some conditions ``[B, N]`` are ``NEAR`` and ``OUTSIDE``."""
    way = condition[1] - condition[0]
    reading = (OUTSIDE - NEAR) * way / np.square(way).sum()
    center = condition[0] @ reading - NEAR
    return Envelope(reading[:, None].astype(np.float32), np.array([center], np.float32))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes]:
    """An artifact with the plan ``fast``, whose correction has jumps, one of the pruner, and an envelope; the file."""
    folder, program = tmp_path_factory.mktemp("envelope") / "artifact", toy_program(STEPS, BLOCKS, normed=True)
    models = lower_program(program)
    write_artifact(program, models, folder)
    model = lower_single_file(program, models, program.weights).SerializeToString()
    artifact, rng = load_artifact(folder), np.random.default_rng(4)
    cells = random_plan(
        rng, artifact.manifest.steps, artifact.manifest.groups, np.zeros((STEPS, BLOCKS), np.bool_), 0.3
    )
    cells[cells == 3] = 2
    correction = random_correction(artifact, rng)
    envelope = between(conditions(artifact, *two_calls(artifact)))
    pruner = random_pruner(program, 2)
    both = dict.fromkeys(("fast", "pruner"), correction)
    store_schedules(folder, pruner, {"fast": cells}, "fast", {}, corrections=both, envelope=envelope)
    return folder, model


def two_calls(artifact: Artifact) -> tuple[dict[str, np.ndarray], Noise]:
    return random_inputs(artifact, np.random.default_rng(0), 2)


def some(given: tuple[dict[str, np.ndarray], Noise], streams: list[int]) -> tuple[dict[str, np.ndarray], Noise]:
    obs, noise = given
    assert noise.steps is not None
    return {key: one[streams] for key, one in obs.items()}, Noise(noise.initial[streams], noise.steps[:, streams])


def raw(artifact: Artifact, streams: list[int]) -> tuple[dict[str, np.ndarray], Noise]:
    """These of the two calls, as a robot gives them."""
    obs, noise = some(two_calls(artifact), streams)
    normalizer = artifact.manifest.spec.observations["obs"].normalizer
    assert normalizer is not None
    return {"obs": normalizer.unnormalize(obs["obs"])}, noise


def tensors(obs: dict[str, np.ndarray], noise: Noise) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
    assert noise.steps is not None
    made = {key: torch.from_numpy(one) for key, one in obs.items()}
    return made, torch.from_numpy(noise.initial), torch.from_numpy(noise.steps)


def by_hand(artifact: Artifact) -> np.ndarray:
    """Samples of the two calls: of the first with its plan, of the second with even steps and no correction."""
    plan, given = artifact.plans["fast"], two_calls(artifact)
    assert plan.correction is not None
    count = max(1, int(plan.correction.anchors.sum()))
    even = np.full((STEPS, BLOCKS), 2, np.int8)
    even[[step * STEPS // count for step in range(count)]] = 0
    whole = open_runtime(replace(artifact, envelope=None), "reference")
    near, _ = whole.predict(*some(given, [0]), Plan(cells=plan.cells, correction=plan.correction))
    whole.reset()
    far, _ = whole.predict(*some(given, [1]), Plan(cells=even))
    return np.concatenate([near, far])


def test_the_distance_is_that_from_the_centre() -> None:
    envelope = Envelope(np.array([[2, 0], [0, 1], [0, 0]], np.float32), np.array([1, 1], np.float32))
    np.testing.assert_allclose(envelope.distance(np.array([[2, 5, 9], [0.5, 1, 7]], np.float32)), [5, 0])


@pytest.mark.parametrize(
    ("reading", "center"),
    [
        (np.zeros((3, 2), np.float32), np.zeros(3, np.float32)),
        (np.zeros((3, 2)), np.zeros(2, np.float32)),
        (np.zeros(3, np.float32), np.zeros(0, np.float32)),
        (np.full((3, 2), np.nan, np.float32), np.zeros(2, np.float32)),
    ],
)
def test_what_is_no_envelope_is_refused(reading: np.ndarray, center: np.ndarray) -> None:
    with pytest.raises(IllegalPlanError, match="an envelope has a reading float32"):
        Envelope(reading, center)


def test_one_of_another_policy_is_refused(made: tuple[Path, bytes]) -> None:
    artifact = load_artifact(made[0])
    assert artifact.envelope is not None
    store = load_artifact(made[0]).manifest.condition_numbers
    wrong = Envelope(np.zeros((store + 1, 1), np.float32), np.zeros(1, np.float32))
    arrays = envelope_arrays(wrong)
    with pytest.raises(ArtifactError, match=f"here: expected an envelope of {store} numbers.*one of {store + 1}"):
        read_envelope(arrays, artifact.manifest, "here")
    with pytest.raises(ArtifactError, match="here: expected an envelope of .*found .'center'."):
        read_envelope({"envelope/center": arrays["envelope/center"]}, artifact.manifest, "here")
    assert read_envelope({"fast": np.zeros(1)}, artifact.manifest, "here") is None


@pytest.mark.parametrize("runtime", ["reference", "onnxruntime", "torch"])
def test_a_call_far_outside_has_even_steps_and_no_correction(made: tuple[Path, bytes], runtime: str) -> None:
    artifact = load_artifact(made[0])
    opened, given, wanted = open_runtime(artifact, runtime), two_calls(artifact), by_hand(artifact)
    plan, terms = artifact.plans["fast"], 2 * call_terms(artifact)
    assert plan.cells is not None and plan.correction is not None
    even = plain_cells(plan.correction, BLOCKS)
    for streams in ([0], [1], [0, 1], [1, 1, 0]):
        opened.reset()
        sample, report = opened.predict(*some(given, streams), plan)
        assert_equal_but_for_rounding(sample, wanted[streams], terms)
        np.testing.assert_allclose(report.outside, np.array([NEAR, OUTSIDE])[streams], rtol=1e-4)
        assert report.far == (1 in streams)
        np.testing.assert_array_equal(report.plan, [even if i else plan.cells for i in streams])
        assert report.computed == tuple(int((one == 0).sum()) for one in report.plan)
    assert NEAR < FAR < OUTSIDE


@pytest.mark.parametrize("runtime", ["reference", "onnxruntime", "torch"])
def test_so_have_calls_whose_plan_the_pruner_makes(made: tuple[Path, bytes], runtime: str) -> None:
    artifact = load_artifact(made[0])
    opened, given, wanted = open_runtime(artifact, runtime), two_calls(artifact), by_hand(artifact)
    for streams in ([1], [0, 1]):
        opened.reset()
        sample, _ = opened.predict(*some(given, streams), artifact.plans["pruner"])
        assert_equal_but_for_rounding(sample[-1:], wanted[1:], 2 * call_terms(artifact))


@pytest.mark.parametrize("runtime", ["reference", "onnxruntime", "torch"])
def test_the_prologue_is_computed_once(made: tuple[Path, bytes], runtime: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may be an image encoder, of which no call has time for two."""
    artifact = load_artifact(made[0])
    opened, given = open_runtime(artifact, runtime), two_calls(artifact)
    started, start = [], type(opened.backend).start

    def noted(self: Any, call: Any) -> Any:
        started.append(sorted(call.obs))
        return start(self, call)

    monkeypatch.setattr(type(opened.backend), "start", noted)
    opened.predict(*some(given, [1]), artifact.plans["fast"])
    assert started == [sorted(given[0]), []]


def test_others_are_as_they_would_be_without(made: tuple[Path, bytes]) -> None:
    """What has no correction has nothing to lose, and an artifact without an envelope says nothing of it."""
    artifact = load_artifact(made[0])
    given = some(two_calls(artifact), [1])
    runtimes = open_runtime(artifact), open_runtime(replace(artifact, envelope=None))
    for name in ("dense", "fast"):
        (own, report), (other, known) = (one.predict(*given, artifact.plans[name]) for one in runtimes)
        assert np.array_equal(own, other) == (name == "dense")
        assert report.outside == (() if name == "dense" else pytest.approx((OUTSIDE,), rel=1e-4))
        assert known.outside == () and not known.far
        for one in runtimes:
            one.reset()


def test_after_a_call_in_which_some_were_far_no_residual_is_read(made: tuple[Path, bytes]) -> None:
    artifact = load_artifact(made[0])
    opened, given, plan = open_runtime(artifact), two_calls(artifact), artifact.plans["fast"]
    again = np.full((STEPS, BLOCKS), 3, np.int8)
    again[0] = 0
    reads = Plan(cells=again, repair=True)
    opened.predict(*given, artifact.plans["dense"])
    assert opened.predict(*given, reads)[1].legalised == (0, 0)
    opened.predict(*given, plan)
    assert opened.predict(*given, reads)[1].legalised == ((STEPS - 1) * BLOCKS,) * 2


def test_a_module_does_the_same(made: tuple[Path, bytes]) -> None:
    artifact = load_artifact(made[0])
    policy = CompiledPolicy(artifact, open_runtime(artifact), seed=0)
    terms = 4 * call_terms(artifact)
    for name in ("fast", "pruner"):
        module = ttscompile.to_module(made[0], name)
        for streams in ([0], [1], [0, 1]):
            obs, noise = raw(artifact, streams)
            policy.reset()
            wanted = policy.predict_action(obs, noise=noise, plan=name)["action_pred"]
            found = module(*tensors(obs, noise))
            assert_equal_but_for_rounding(found[0] if name == "pruner" else found, wanted, terms)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fast", "pruner"])
def test_so_does_what_is_exported(made: tuple[Path, bytes], name: str) -> None:
    artifact = load_artifact(made[0])
    module = ttscompile.to_module(made[0], name)
    with torch.no_grad():
        exported = None
        for streams in ([0], [1]):
            inputs = tensors(*raw(artifact, streams))
            exported = exported or torch.export.export(module, inputs)
            found, wanted = (one(*inputs) for one in (exported.module(), module))
            if name == "pruner":
                np.testing.assert_array_equal(found[1], wanted[1])
                found, wanted = found[0], wanted[0]
            assert_equal_but_for_rounding(found, wanted, 4 * call_terms(artifact))


def test_the_single_file_does_the_same(made: tuple[Path, bytes]) -> None:
    artifact = load_artifact(made[0])
    wanted, chunk = by_hand(artifact), artifact.manifest.spec.chunk
    known = inputs_of(made[0], "fast")
    plan = known.pop("plan")[0]
    known.pop("rollout_keep")
    for streams in ([0], [1], [0, 1, 1]):
        obs, noise = raw(artifact, streams)
        out = Episode(made[1], len(streams)).call(obs, noise, plan, **known)
        expected = chunk.unnormalized(wanted[streams])
        assert_equal_but_for_rounding(out["action_pred"], expected, 4 * call_terms(artifact))
        np.testing.assert_allclose(out["outside"], np.array([NEAR, OUTSIDE])[streams], rtol=1e-4)
    nothing = Episode(made[1], 1).call(*raw(artifact, [1]), plan)
    assert nothing["outside"].tolist() == [0]
