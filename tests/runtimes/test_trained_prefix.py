"""Policies that were trained to go on from a prefix: in every runtime, with every plan."""

from dataclasses import replace
from math import prod
from pathlib import Path

import numpy as np
import pytest
import torch

import ttscompile
from tests.lower.whole_call import every_way
from tests.once import Once
from tests.rounding import assert_equal_but_for_rounding
from ttscompile import ObservationSpec
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.lattice import dense_plan
from ttscompile.core.plan import Plan
from ttscompile.errors import ObservationError, SpecError
from ttscompile.ir.pieces import STEP
from ttscompile.ir.program import Binding
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.inpainting import known_samples, noise_levels, prefix_refusal
from ttscompile.runtimes.reference.model import ReferenceModel

from . import committed
from .agreement import RUNTIMES, call_terms, corrected_episode, random_inputs
from .committed import ACTIONS, HORIZON, LONGEST, START, WIDTH, Network
from .plans import random_correction


@pytest.fixture(params=committed.SAMPLERS)
def sampler(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def artifact_of(once: Once, sampler: str) -> Artifact:
    return load_artifact(once.compiled(f"committed {sampler}", lambda to: committed.compiled(sampler, to))[0])


@pytest.mark.slow
@pytest.mark.parametrize("streams", [1, 3])
def test_runtimes_agree_with_random_plans_and_prefixes(once: Once, sampler: str, streams: int) -> None:
    """Lengths go up and down, with calls without a prefix and corrections in between."""
    artifact, rng = artifact_of(once, sampler), np.random.default_rng(streams)
    corrections = [None, random_correction(artifact, rng), random_correction(artifact, rng)]
    for samples, prefix in corrected_episode(artifact, rng, streams, corrections, (2, 3, None, 1, 3, 0, 2)):
        if prefix is not None:
            here = samples[-1][:, START : START + prefix.shape[1]]
            np.testing.assert_array_equal(here[..., :ACTIONS], prefix)
            assert not here[..., ACTIONS:].any()  # channels that are no actions


@pytest.mark.slow
def test_the_loop_is_that_of_the_paper_written_out(once: Once) -> None:
    """Runge and Kutta's: the network sees the actions themselves in each evaluation, and is told which they are."""
    artifact, module = artifact_of(once, "rk4"), Network().eval()
    assert noise_levels(artifact.manifest.spec.sampler) is None  # inpainting could not do it
    rng = np.random.default_rng(0)
    obs, noise = random_inputs(artifact, rng, 2)
    prefix = rng.uniform(-1, 1, (2, 2, ACTIONS)).astype(np.float32)
    clean = torch.nn.functional.pad(torch.from_numpy(prefix), (0, 1))
    told = {"obs": torch.from_numpy(obs["obs"]), "committed": torch.full((2, 1), 2)}

    def held(x: torch.Tensor) -> torch.Tensor:
        return torch.cat([x[:, :START], clean, x[:, START + 2 :]], 1)

    def slope(x: torch.Tensor, time: float) -> torch.Tensor:
        made: torch.Tensor = module(held(x), torch.full((2,), time), **told)
        return made

    x, width = torch.from_numpy(noise.initial), -0.5
    with torch.no_grad():
        for time in (1.0, 0.5):
            x = held(x)
            first = slope(x, time)
            second = slope(x + width / 2 * first, time + width / 2)
            third = slope(x + width / 2 * second, time + width / 2)
            fourth = slope(x + width * third, time + width)
            x = x + width / 6 * (first + 2 * second + 2 * third + fourth)
    plan = Plan(cells=dense_plan(artifact.manifest.steps, len(artifact.manifest.groups)))
    for name in RUNTIMES:
        found, _ = open_runtime(artifact, name).predict(obs, noise, plan, prefix=prefix)
        assert_equal_but_for_rounding(found, held(x).numpy(), call_terms(artifact))
        without, _ = open_runtime(artifact, name).predict(obs, noise, plan)
        assert np.abs(found - without)[:, START + 2 :].max() > 1e-2


@pytest.mark.slow
def test_what_the_loop_reads_has_a_row_a_step_and_none_an_action(once: Once) -> None:
    """At its published size a row for each action of all norms would fill hundreds of megabytes."""
    manifest = artifact_of(once, "ddpm").manifest
    assert STEP not in manifest.pieces
    sizes = [prod(one.type.at(1)) for one in manifest.contexts.values() if one.binding is not Binding.CONDITION]
    assert max(sizes) == WIDTH
    (mask,) = (one for one in manifest.contexts.values() if one.type.dtype == "bool")
    assert mask.type.at(1) == (1, HORIZON, 1)


@pytest.mark.slow
def test_a_plan_and_a_correction_do_not_see_the_prefix(once: Once) -> None:
    artifact = artifact_of(once, "ddpm")
    model = ReferenceModel.from_view(view_of(artifact))
    obs = {"obs": torch.randn(2, 4)}
    contexts = [model.prologue(obs | count) for count in ({}, {"committed": torch.full((2, 1), 3)})]
    told = [np.concatenate([one.numpy().ravel() for one in each.condition.values()]) for each in contexts]
    assert not np.array_equal(told[0], told[1])
    for read in (model.condition, model.logits):
        assert torch.equal(*(read(each) for each in contexts))


@pytest.mark.slow
def test_a_policy_says_how_long_a_prefix_it_takes_and_refuses_a_longer_one(once: Once) -> None:
    artifact = artifact_of(once, "ddpm")
    policy = ttscompile.load(artifact.path, seed=0)
    info = policy.info
    assert (info.prefix_refusal, info.trained_prefix) == (None, LONGEST)
    assert set(info.observation) == {"obs"}
    obs, prefix = {"obs": np.zeros((1, 4), np.float32)}, np.zeros((1, LONGEST + 1, ACTIONS), np.float32)
    with pytest.raises(
        ObservationError, match=r"prefix holds 4 actions; the policy was trained to go on from at most 3"
    ):
        policy.predict_action(obs, prefix=prefix)
    kept = policy.predict_action(obs, prefix=prefix[:, 1:])["action"][:, :LONGEST]
    assert_equal_but_for_rounding(kept, prefix[:, 1:], terms=4)


def test_no_noise_is_put_where_a_prefix_is() -> None:
    spec = committed.spec(committed.ddpm())
    prefix = np.ones((1, 2, ACTIONS), np.float32)
    known = known_samples(spec, prefix, np.full((1, *spec.sample), np.nan, np.float32))
    assert known is not None
    np.testing.assert_array_equal(known.values, np.broadcast_to(np.array([1, 1, 0], np.float32), (9, 1, 2, 3)))


def test_channels_that_share_matrices_and_tables_without_noise_levels_are_no_reason_to_refuse(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ttscompile.core.correction.LARGEST", 1)
    for make in committed.SAMPLERS.values():
        spec = committed.spec(make())
        assert prefix_refusal(spec) is None
        assert prefix_refusal(replace(spec, trained_prefix=0)) is not None


def test_a_specification_that_cannot_be_is_refused() -> None:
    spec = committed.spec(committed.ddpm())
    assert replace(spec, trained_prefix=4).trained_prefix == 4
    with pytest.raises(SpecError, match=r"trained_prefix must be an integer of at least 0 and at most 4; found 5"):
        replace(spec, trained_prefix=5)
    with pytest.raises(SpecError, match=r"'committed'"):
        replace(spec, observations={"committed": ObservationSpec((1,))})
    replace(spec, observations={"committed": ObservationSpec((1,))}, trained_prefix=0)


@pytest.mark.slow
def test_a_module_and_a_single_file_compute_the_call_without_a_prefix(tmp_path: Path) -> None:
    folder, file = tmp_path / "compiled", tmp_path / "whole.onnx"
    ttscompile.compile_denoiser(Network(), committed.spec(committed.rk4()), folder, single_file=file)
    artifact = load_artifact(folder)
    obs, noise = random_inputs(artifact, np.random.default_rng(0), 2)
    made = every_way(folder, file.read_bytes(), obs, ttscompile.Noise(noise.initial))
    for found in made.values():
        assert_equal_but_for_rounding(found, made["reference"], call_terms(artifact))
