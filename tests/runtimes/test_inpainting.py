"""Prefixes: committed actions that a call keeps, and inpaints the rest of its chunk to."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler

import ttscompile
from tests.rounding import assert_equal_but_for_rounding
from ttscompile import Affine, ChunkSpec, SamplerTable
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.artifact.write import write_artifact
from ttscompile.core.lattice import dense_plan, uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.errors import ObservationError
from ttscompile.ir.program import Program
from ttscompile.lower.program import lower_program
from ttscompile.policies.octo_loop import own_table, schedule
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.inpainting import TOLERANCE, Known, MaskedUpdates, known_samples, noise_levels, prefix_refusal
from ttscompile.runtimes.reference.model import ReferenceModel
from ttscompile.samplers.flow import flow_matching_table
from ttscompile.samplers.table import sampler_table, set_timesteps

from .agreement import call_terms, corrected_episode, random_inputs
from .conftest import MakeArtifact
from .plans import random_correction
from .toys import toy_program

STEPS, BLOCKS, HORIZON, START = 8, 4, 6, 1
BETAS: dict[str, Any] = {"num_train_timesteps": 40, "beta_schedule": "squaredcos_cap_v2"}


def diffusion(scheduler: type[Any], steps: int = STEPS, **settings: Any) -> tuple[SamplerTable, Any]:
    made = scheduler(**(BETAS | settings))
    return sampler_table(made, steps), made


def noise_solver(**settings: Any) -> SamplerTable:
    """DPM-Solver as it was before it was called ++."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`algorithm_types dpmsolver", FutureWarning)
        table, _ = diffusion(
            DPMSolverMultistepScheduler, algorithm_type="dpmsolver", final_sigmas_type="sigma_min", **settings
        )
    return table


def ddpm() -> SamplerTable:
    return diffusion(DDPMScheduler)[0]


def ddim() -> SamplerTable:
    return diffusion(DDIMScheduler, prediction_type="v_prediction")[0]


def toy(sampler: SamplerTable) -> Program:
    program = toy_program(STEPS, BLOCKS, pruner=False, normed=True, horizon=HORIZON)
    return replace(program, spec=replace(program.spec, sampler=sampler))


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Artifact]:
    """The toy with DDPM and with DDIM; both clip, so that their graphs are the same, and are lowered once."""
    folder, made = tmp_path_factory.mktemp("inpainting"), {"ddpm": toy(ddpm()), "ddim": toy(ddim())}
    lowered = lower_program(made["ddpm"])
    for name, program in made.items():
        write_artifact(program, lowered, folder / name)
    return {name: load_artifact(folder / name) for name in made}


@pytest.fixture
def artifact(artifacts: dict[str, Artifact]) -> Artifact:
    return artifacts["ddpm"]


@pytest.mark.parametrize(
    ("scheduler", "settings"),
    [
        (DDPMScheduler, {}),
        (DDPMScheduler, {"clip_sample": False, "beta_schedule": "linear"}),
        (DDIMScheduler, {"timestep_spacing": "trailing"}),
        (DDIMScheduler, {"prediction_type": "v_prediction"}),
        (DDIMScheduler, {"prediction_type": "v_prediction", "rescale_betas_zero_snr": True}),
        (DPMSolverMultistepScheduler, {}),
        (DPMSolverMultistepScheduler, {"algorithm_type": "sde-dpmsolver++", "prediction_type": "v_prediction"}),
    ],
)
def test_noise_levels_are_those_of_the_schedule(scheduler: type[Any], settings: dict[str, Any]) -> None:
    made = scheduler(**(BETAS | settings))
    table = sampler_table(made, STEPS)
    levels = noise_levels(table)
    assert levels is not None
    kept = made.alphas_cumprod.numpy()[table.timesteps.astype(int)]
    assert_equal_but_for_rounding(levels, [np.sqrt(kept), np.sqrt(1 - kept)], terms=36)
    moved = noise_levels(table.with_skip())
    assert moved is not None
    np.testing.assert_allclose(moved, levels, atol=TOLERANCE)


@pytest.mark.parametrize(("start", "end"), [(0.0, 1.0), (1.0, 0.0)])
def test_noise_levels_of_a_straight_flow_are_its_times(start: float, end: float) -> None:
    times = start + (end - start) * np.array([0, 0.2, 0.5, 0.6, 1])
    levels = noise_levels(flow_matching_table(times.tolist(), timestep_scale=1000))
    assert_equal_but_for_rounding(levels, [[0, 0.2, 0.5, 0.6], [1, 0.8, 0.5, 0.4]], terms=4)


@pytest.mark.parametrize(
    "made",
    [
        lambda: diffusion(DDPMScheduler, prediction_type="sample")[0],
        # What remembers noise rather than clean samples looks like another process, run the wrong way round.
        lambda: noise_solver(prediction_type="sample"),
        lambda: noise_solver(prediction_type="epsilon"),
        lambda: noise_solver(prediction_type="v_prediction"),
        lambda: flow_matching_table(2, "rk4"),
        lambda: flow_matching_table([0.3, 0.5, 1.0]),
        lambda: own_table(*schedule(100), bound=5.0),  # of Octo, whose x0 is its clipped sample
        lambda: toy_program().spec.sampler,
    ],
)
def test_a_table_without_noise_levels_is_seen(made: Callable[[], SamplerTable]) -> None:
    assert noise_levels(made()) is None


@pytest.mark.slow
@pytest.mark.parametrize("streams", [1, 3])
@pytest.mark.parametrize("name", ["ddpm", "ddim"])
def test_runtimes_agree_on_prefixes(artifacts: dict[str, Artifact], name: str, streams: int) -> None:
    """Lengths go up and down, with calls without a prefix and corrections in between."""
    artifact, rng = artifacts[name], np.random.default_rng(streams)
    corrections = [None, random_correction(artifact, rng), random_correction(artifact, rng)]
    for samples, prefix in corrected_episode(artifact, rng, streams, corrections, (2, 5, None, 1, 3, 4, 0, 2, 5)):
        if prefix is not None:
            for each in samples:
                np.testing.assert_array_equal(each[:, START : START + prefix.shape[1]], prefix)


@pytest.mark.slow
def test_between_steps_the_committed_actions_have_the_noise_of_the_step(artifact: Artifact) -> None:
    table, made = diffusion(DDPMScheduler)
    model = ReferenceModel.from_view(view_of(artifact))
    obs, noise = random_inputs(artifact, np.random.default_rng(0), 2)
    prefix = np.random.default_rng(1).uniform(-1, 1, (2, 3, 2)).astype(np.float32)
    known = known_samples(artifact.manifest.spec, prefix, noise.initial)
    contexts = model.prologue({key: torch.from_numpy(value) for key, value in obs.items()})
    initial, draws = torch.from_numpy(noise.initial), torch.from_numpy(noise.steps)
    plan = dense_plan(STEPS, BLOCKS)
    result = model.denoise(contexts, initial, draws, plan, known=known)
    here = slice(START, START + 3)
    for k, sample in enumerate(result.samples[:-1]):
        expected = made.add_noise(torch.from_numpy(prefix), initial[:, here], torch.tensor(int(table.timesteps[k + 1])))
        assert_equal_but_for_rounding(sample[:, here], expected, terms=4)  # two products and their sum
    assert known is not None
    first = made.add_noise(torch.from_numpy(prefix), initial[:, here], torch.tensor(int(table.timesteps[0])))
    assert_equal_but_for_rounding(known.values[0], first, terms=4)


@pytest.mark.slow
def test_a_network_inpaints_as_the_loop_of_its_scheduler(make_artifact: MakeArtifact) -> None:
    """The definition with a scheduler of diffusers, written out; only the first of two channels is action.

    The scheduler remembers what it predicted, which a prefix does not change.
    """
    # Little noise, so that what a random network predicts without a clip stays small, and what it sees shows.
    table, scheduler = diffusion(DPMSolverMultistepScheduler, beta_schedule="linear")
    assert table.memories == 1
    normalizer = Affine(np.array([0.5]), np.array([0.2]))
    program = toy(table)
    program = replace(program, spec=replace(program.spec, chunk=ChunkSpec(1, START, HORIZON - 1, normalizer)))
    artifact = make_artifact(program)
    model = ReferenceModel.from_view(view_of(artifact))
    rng = np.random.default_rng(0)
    obs, noise = random_inputs(artifact, rng, 2)
    committed = rng.uniform(-1, 1, (2, 3, 1)).astype(np.float32)

    contexts = model.prologue({"obs": torch.from_numpy(obs["obs"])})
    prefix = normalizer.normalize(committed)
    known, initial = torch.from_numpy(prefix), torch.from_numpy(noise.initial)
    here, sample = (slice(None), slice(START, START + 3), slice(1)), initial.clone()
    set_timesteps(scheduler, STEPS)
    for k, t in enumerate(scheduler.timesteps):
        sample[here] = scheduler.add_noise(known, initial[here], t[None])
        stream = model.stem(sample, k, contexts)
        for b in range(BLOCKS):
            stream = stream + model.block(b, k, stream, contexts)
        sample = scheduler.step(model.tail(stream, k, contexts), t, sample).prev_sample
    sample[here] = known

    given = program.spec.observations["obs"].normalizer
    assert given is not None
    terms = call_terms(artifact)
    for name in ("reference", "onnxruntime"):
        runtime = open_runtime(artifact, name)
        found, _ = runtime.predict(obs, noise, Plan(cells=dense_plan(STEPS, BLOCKS)), prefix=prefix)
        assert_equal_but_for_rounding(found, sample, terms)
        plain, _ = runtime.predict(obs, noise, Plan(cells=dense_plan(STEPS, BLOCKS)))
        assert np.abs(found - plain)[:, START : START + 3, 1].max() > 1e-2  # the other channel saw it
        policy = ttscompile.load(artifact.path, runtime=name)
        assert policy.info.prefix_refusal is None
        out = policy.predict_action({"obs": given.unnormalize(obs["obs"])}, noise, prefix=committed)
        assert_equal_but_for_rounding(out["action"][:, :3], committed, terms=4)  # normalised and back
        assert_equal_but_for_rounding(out["action_pred"], normalizer.unnormalize(found[..., :1]), terms)


@pytest.mark.parametrize(("groups", "actions"), [(1, 3), (3, 3), (3, 2)])
def test_matrices_are_masked_where_a_prefix_is_and_put_back(groups: int, actions: int) -> None:
    """Of two memories beside the sample, and of channels that are no actions, nothing is taken."""
    plain = np.random.default_rng(0).uniform(1, 2, (4, groups, 11, 3 * HORIZON)).astype(np.float32)
    masked = MaskedUpdates(plain)
    before = plain.copy()
    for length in (3, 5, 1, 1, 4):
        known = np.zeros((1, 1, length, actions), np.float32)
        masked.mask(Known(slice(START, START + length), slice(actions), known))
        expected = before.copy()
        expected[:, : min(groups, actions), :, START : START + length] = 0
        np.testing.assert_array_equal(masked.updates, expected)
    np.testing.assert_array_equal(plain, before)


def test_no_action_committed_is_no_prefix_and_a_prefix_leaves_nothing_behind(artifact: Artifact) -> None:
    runtime = open_runtime(artifact)
    rng = np.random.default_rng(0)
    obs, noise = random_inputs(artifact, rng, 2)
    correction = random_correction(artifact, rng)
    plan = uniform_plan(STEPS, BLOCKS, 3)
    before = runtime.predict(obs, noise, Plan(cells=plan, correction=correction))[0]
    for length in (0, 4, 0, 2, 0):
        prefix = np.zeros((2, length, 2), np.float32)
        assert (known_samples(artifact.manifest.spec, prefix, noise.initial) is None) == (length == 0)
        sample = runtime.predict(obs, noise, Plan(cells=plan, correction=correction), prefix=prefix)[0]
        assert np.array_equal(sample, before) == (length == 0)
    np.testing.assert_array_equal(runtime.predict(obs, noise, Plan(cells=plan, correction=correction))[0], before)


@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_a_call_with_a_prefix_has_the_correction_of_such_calls_and_says_where_that_is_none(
    artifact: Artifact, runtime: str
) -> None:
    rng = np.random.default_rng(3)
    own, late = (random_correction(artifact, rng) for _ in range(2))
    late, cells = replace(late, prefixes=2), uniform_plan(STEPS, BLOCKS, 3)
    both, alone, other = (Plan(cells=cells, correction=one) for one in (replace(own, late=late), own, late))
    (obs, noise), opened = random_inputs(artifact, rng, 1), open_runtime(artifact, runtime)
    prefix = rng.standard_normal((1, 3, 2)).astype(np.float32)
    for count, like, unfitted in ((0, alone, False), (2, other, False), (3, other, True), (0, alone, False)):
        made, report = opened.predict(obs, noise, both, prefix[:, :count])
        np.testing.assert_array_equal(made, opened.predict(obs, noise, like, prefix[:, :count])[0])
        assert report.unfitted is unfitted
    assert opened.predict(obs, noise, alone, prefix)[1].unfitted
    assert not opened.predict(obs, noise, replace(alone, correction=None), prefix)[1].unfitted


def test_a_prefix_that_does_not_fit_is_refused_and_nothing_is_executed(artifact: Artifact) -> None:
    policy = ttscompile.load(artifact.path, seed=0)
    obs = {"obs": np.zeros((2, 2), np.float32)}
    good = np.zeros((2, 3, 2), np.float32)
    bad = np.full_like(good, 0.5)
    bad[1, 2, 0] = np.nan
    cases: list[tuple[Any, str]] = [
        (good[0], r"float32 \[B, N, Da\] = \[2, N, 2\]; found float32 \[3, 2\]"),
        (good[:1], r"found float32 \[1, 3, 2\]"),
        (good[..., :1], r"found float32 \[2, 3, 1\]"),
        (good.astype(np.float64), r"found float64"),
        (good.tolist(), r"prefix is a list; expected a numpy array"),
        (np.zeros((2, 6, 2), np.float32), r"prefix holds 6 actions; the chunk has 5"),
        (bad, r"prefix must be finite; found nan at index \(1, 2, 0\)"),
    ]
    for prefix, message in cases:
        with pytest.raises(ObservationError, match=message):
            policy.predict_action(obs, prefix=prefix)
    first = policy.predict_action(obs, prefix=good)["action_pred"]
    policy.reset(seed=0)
    np.testing.assert_array_equal(policy.predict_action(obs, prefix=torch.from_numpy(good))["action_pred"], first)


def test_a_policy_whose_sampler_tells_no_noise_levels_says_so(toy_artifact: Artifact) -> None:
    policy = ttscompile.load(toy_artifact.path)
    assert policy.info.prefix_refusal is not None
    obs = {"obs": np.zeros((1, 2), np.float32)}
    for call in (policy.predict_action, policy.predict_action_chunk):
        with pytest.raises(ObservationError, match=r"takes no prefix: the table of its sampler 'toy' does not give"):
            call(obs, prefix=np.zeros((1, 1, 2), np.float32))
        call(obs, prefix=np.zeros((1, 0, 2), np.float32))


def test_where_channels_share_their_matrices_all_of_them_must_be_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = replace(toy(ddim()).spec, chunk=ChunkSpec(1, START, HORIZON))
    assert prefix_refusal(spec) is None
    monkeypatch.setattr("ttscompile.core.correction.LARGEST", 1)
    assert "only 1 of the sample's 2 channels are actions" in (prefix_refusal(spec) or "")
