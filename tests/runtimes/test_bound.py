"""A corrected sample leaves the range of the sampler no more than the policy's own does."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler

import ttscompile
from tests.lower.whole_call import Episode
from tests.plans import store_schedules
from tests.rounding import assert_equal_but_for_rounding
from ttscompile import Noise, SamplerTable
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.golden import GoldenPlan
from ttscompile.artifact.write import write_artifact
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.lower.program import lower_program
from ttscompile.lower.single_file import lower_single_file
from ttscompile.runtimes import open_runtime
from ttscompile.samplers.edm import edm_table
from ttscompile.samplers.flow import flow_matching_table
from ttscompile.samplers.table import sampler_table
from ttscompile.verification.calls import replay

from .agreement import call_terms, random_inputs
from .plans import random_correction
from .toys import toy_program

pytestmark = pytest.mark.slow

STEPS, BLOCKS, HORIZON, STREAMS = 6, 3, 4, 2
RUNTIMES = ("onnxruntime", "torch", "reference")


def diffusion(scheduler: type[Any], **settings: Any) -> SamplerTable:
    return sampler_table(scheduler(num_train_timesteps=42, beta_schedule="squaredcos_cap_v2", **settings), STEPS)


@pytest.mark.parametrize(
    ("make", "bound"),
    [
        (lambda: diffusion(DDPMScheduler), 1.0),
        (lambda: diffusion(DDPMScheduler, clip_sample_range=2.0), 2.0),
        # It ends above timestep 0, where diffusers adds noise of the deviation 1e-10.
        (lambda: diffusion(DDPMScheduler, timestep_spacing="trailing"), 1.0),
        (lambda: diffusion(DDIMScheduler, timestep_spacing="trailing"), 1.0),
        (lambda: diffusion(DDIMScheduler).with_skip(), 1.0),
        (lambda: diffusion(DDPMScheduler, clip_sample=False), None),
        # The last step leaves some of the noise in the sample, and so bounds nothing.
        (lambda: diffusion(DDIMScheduler, set_alpha_to_one=False), None),
        (lambda: diffusion(DPMSolverMultistepScheduler), None),
        (lambda: flow_matching_table(4), None),
        (lambda: edm_table([1.0, 0.5, 0.0], sigma_data=0.5), None),
    ],
)
def test_which_samplers_bound_what_they_give(make: Callable[[], SamplerTable], bound: float | None) -> None:
    assert make().bound == bound


class Corrected(NamedTuple):
    """An artifact whose plan ``fast`` has a large correction, with its single file."""

    artifact: Artifact
    correction: Correction
    plan: np.ndarray
    file: bytes


@pytest.fixture(scope="module")
def corrected(tmp_path_factory: pytest.TempPathFactory) -> Corrected:
    folder: Path = tmp_path_factory.mktemp("bound") / "artifact"
    program = toy_program(STEPS, BLOCKS, pruner=False, horizon=HORIZON)
    program = replace(program, spec=replace(program.spec, sampler=diffusion(DDPMScheduler)))
    models = lower_program(program)
    write_artifact(program, models, folder)
    correction = random_correction(load_artifact(folder), np.random.default_rng(0))
    bias = correction.bias.copy()
    bias[-1] = np.where(np.arange(HORIZON) % 2, 5, -5)
    bias[-1, :, :, 0] = 0
    correction = replace(correction, bias=bias)
    plan = uniform_plan(STEPS, BLOCKS, 2)
    store_schedules(folder, None, {"fast": plan, "bare": plan}, "fast", {}, corrections={"fast": correction})
    file = lower_single_file(program, models, program.weights).SerializeToString()
    return Corrected(load_artifact(folder), correction, plan, file)


def normalized(artifact: Artifact, predicted: np.ndarray) -> np.ndarray:
    chunk = artifact.manifest.spec.chunk
    assert chunk.normalizer is not None
    return chunk.normalizer.normalize(predicted)


def test_every_way_to_make_a_call_bounds_it_alike(corrected: Corrected) -> None:
    artifact, correction, plan, file = corrected
    obs, noise = random_inputs(artifact, np.random.default_rng(1), STREAMS)
    found = {
        name: ttscompile.load(artifact.path, name).predict_action(obs, Noise(noise.initial, noise.steps))
        for name in RUNTIMES
    }
    made = {name: each["action_pred"] for name, each in found.items()}
    made["file"] = Episode(file, STREAMS).call(obs, noise, plan, **correction.inputs())["action_pred"]
    assert noise.steps is not None
    given = {key: torch.from_numpy(value) for key, value in obs.items()}
    draws = torch.from_numpy(noise.initial), torch.from_numpy(noise.steps)
    made["module"] = ttscompile.to_module(artifact.path)(given, *draws).numpy()
    terms = call_terms(artifact) + STEPS * 6 * HORIZON
    for predicted in made.values():
        sample = normalized(artifact, predicted)
        assert_equal_but_for_rounding(predicted, made["reference"], terms)
        assert np.abs(sample).max() <= 1 + 1e-6
        np.testing.assert_allclose(sample[:, 1::2], 1, atol=1e-6)
        np.testing.assert_allclose(sample[:, 2::2], -1, atol=1e-6)
        assert (np.abs(sample[:, 0]) < 1).any(), "what is within the range is left there"


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_committed_actions_stay_what_they_are(corrected: Corrected, runtime: str) -> None:
    """Those of a prefix may be beyond the range of training: they are executed already."""
    artifact, correction, plan, _ = corrected
    obs, noise = random_inputs(artifact, np.random.default_rng(2), STREAMS)
    start, channels = artifact.manifest.spec.chunk.start, artifact.manifest.spec.chunk.action_dim
    prefix = np.full((STREAMS, 1, channels), 1.5, np.float32)
    opened = open_runtime(artifact, runtime)
    sample, _ = opened.predict(obs, noise, Plan(cells=plan, correction=correction), prefix=prefix)
    np.testing.assert_array_equal(sample[:, start : start + 1, :channels], prefix)
    rest = np.delete(sample, start, axis=1)
    assert np.abs(rest).max() == 1


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_what_overflows_is_not_made_an_action(corrected: Corrected, runtime: str) -> None:
    artifact, correction, _, _ = corrected
    obs, noise = random_inputs(artifact, np.random.default_rng(3), 1)
    policy = ttscompile.load(artifact.path, runtime)
    weights = np.full_like(correction.weights, 3e38)
    plan = replace(policy.plans["fast"], correction=replace(correction, weights=weights))
    with pytest.raises(ttscompile.TtscompileError, match="not finite"):
        policy.predict_action(obs, Noise(noise.initial, noise.steps), plan)


def test_a_record_of_before_is_held_against_what_it_is_bounded_to(corrected: Corrected) -> None:
    artifact, correction, plan, _ = corrected
    obs, noise = random_inputs(artifact, np.random.default_rng(4), STREAMS)
    opened = open_runtime(artifact)
    sample, _ = opened.predict(obs, noise, Plan(cells=plan, correction=correction))
    golden: Any = SimpleNamespace(initial=noise.initial, draws=noise.steps, network_observations=lambda spec: obs)
    golden.in_loop = lambda loop: golden
    plans = np.broadcast_to(plan, (2, STREAMS, *plan.shape))
    for beyond, expected in ((5.0, True), (0.5, False)):
        stored = np.where(np.abs(sample) == 1, sample * beyond, sample)
        record = GoldenPlan(plan=plans, sample=np.stack([stored, stored[::-1]]), path=np.zeros(0, np.float32))
        assert (replay(artifact, golden, opened, artifact.plans["fast"], record)[3] < 1e-3) == expected
