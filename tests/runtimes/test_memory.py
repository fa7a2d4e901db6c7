"""Samplers that remember: DPM-Solver++ and rk4 in the reference, in onnxruntime, and in the single file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler

from tests.lower.whole_call import Episode as FileEpisode, inputs, make
from tests.rounding import Counted, amplified, assert_equal_but_for_rounding, bound
from ttscompile import Noise, SamplerTable, Source, flow_matching_table
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import Calls
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.sparse_loop import fit_correction
from ttscompile.core.correction import correction_flops
from ttscompile.core.plan import Plan
from ttscompile.core.update import update_flops
from ttscompile.ir.program import Program
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.reference.model import noise_tensors
from ttscompile.samplers.table import sampler_table

from .agreement import call_terms, largest_difference, random_inputs
from .literal import Episode
from .plans import random_correction, random_plan
from .toys import as_functions, model_of, pencil_program, toy_program

C, T = Source.COMPUTE, Source.TIMESTEP


def solver(steps: int, **settings: object) -> SamplerTable:
    betas = {"num_train_timesteps": 50, "beta_schedule": "linear", "beta_end": 0.2}
    return sampler_table(DPMSolverMultistepScheduler(**betas, **settings), steps, name="dpmsolver++")


TABLES = {
    "rk4": flow_matching_table(2, "rk4", start=1.0, end=0.0),
    "dpmsolver++": solver(6, thresholding=True),
    "third order": solver(5, solver_order=3, prediction_type="sample", algorithm_type="sde-dpmsolver++"),
}
"""With two memories, with one and a clip, and with two and noise."""


def program_of(table: SamplerTable) -> Program:
    program = toy_program(table.steps, pruner=False)
    return replace(program, spec=replace(program.spec, sampler=table))


Made = tuple[Program, Artifact, CompiledPolicy, bytes]


@pytest.fixture(scope="module", params=TABLES)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder: Path = tmp_path_factory.mktemp("memory")
    program = program_of(TABLES[request.param])
    policy, model = make(program, folder)
    return program, load_artifact(folder / "artifact"), policy, model


def test_the_memory_with_a_pencil() -> None:
    """As the pencil's policy, which goes on with ``sample + prediction``, but half of that of step 0 is taken back.

    Step 0: h = 35, f(h) = 3, the sample becomes 38 and so does the memory. Step 1: compute 38 + 6 - 19 = 25; reuse
    38 + 3 - 19 = 22.
    """
    program = pencil_program()
    table = replace(
        program.spec.sampler,
        memory_to_next=np.array([[-0.5], [-0.5]]),
        to_memory=np.array([[[0, 0, 1, 0]], [[0, 0, 7, 7]]]),
    )
    model = model_of(replace(program, spec=replace(program.spec, sampler=table)))
    contexts = model.prologue({"obs": torch.tensor([[-32.0]])})
    for plan, expected in (([C, C], 25), ([C, T], 22)):
        rollout = model.denoise(contexts, torch.full((1, 1, 1), 35.0), None, np.array(plan, np.int8)[:, None])
        assert float(rollout.sample) == expected


@pytest.mark.parametrize("name", TABLES)
def test_the_reference_is_the_formula(name: str) -> None:
    program = program_of(TABLES[name])
    model, rng = model_of(program), np.random.default_rng(0)
    for _ in range(3):
        obs, initial = (rng.standard_normal(shape).astype(np.float32) for shape in ((1, 2), (1, 3, 2)))
        steps = rng.standard_normal((model.steps, 1, 3, 2)).astype(np.float32)
        plan = random_plan(rng, model.steps, model.groups, np.zeros((model.steps, model.blocks), np.bool_), 0.4)
        toy = as_functions(program, obs[0], steps[:, 0])
        with torch.no_grad(), Counted() as counted:
            tensors = torch.from_numpy(initial), torch.from_numpy(steps)
            result = model.denoise(model.prologue({"obs": torch.from_numpy(obs)}), *tensors, plan)
        expected = Episode(toy).call(initial[0].astype(np.float64), plan)
        assert_equal_but_for_rounding(result.sample[0], expected, amplified(counted.terms, program.spec.sampler))


@pytest.mark.slow
def test_both_runtimes_agree(made: Made) -> None:
    artifact = made[1]
    runtimes = open_runtime(artifact, "onnxruntime"), open_runtime(artifact, "reference")
    terms = amplified(call_terms(artifact), artifact.manifest.spec.sampler)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        assert largest_difference(artifact, *runtimes, rng, streams=1 + seed % 3, calls=4) < bound(terms)


@pytest.mark.slow
def test_both_runtimes_agree_under_corrections_and_forget_between_calls(made: Made) -> None:
    artifact, rng = made[1], np.random.default_rng(0)
    runtimes = [open_runtime(artifact, name) for name in ("onnxruntime", "reference")]
    steps, blocks = artifact.manifest.steps, len(artifact.manifest.blocks)
    plan = random_plan(rng, steps, artifact.manifest.groups, np.zeros((steps, blocks), np.bool_), 0.4)
    correction = random_correction(artifact, rng)
    terms = amplified(call_terms(artifact), artifact.manifest.spec.sampler) + steps * 6 * 3
    for streams in (1, 2):
        obs, noise = random_inputs(artifact, rng, streams)
        samples = []
        for runtime in runtimes:
            runtime.reset()
            samples += [runtime.predict(obs, noise, Plan(cells=plan, correction=correction))[0] for _ in range(2)]
        assert_equal_but_for_rounding(samples[0], samples[2], terms)
        np.testing.assert_array_equal(samples[0], samples[1])
        np.testing.assert_array_equal(samples[2], samples[3])
        plain, _ = runtimes[0].predict(obs, noise, Plan(cells=plan))
        assert np.abs(plain - samples[0]).max() > 1e-2


@pytest.mark.slow
def test_the_single_file_agrees(made: Made) -> None:
    program, artifact, policy, model = made
    rng = np.random.default_rng(1)
    for streams in (1, 2):
        policy.reset()
        episode = FileEpisode(model, streams)
        written = np.zeros((program.spec.sampler.steps, len(program.blocks)), np.bool_)
        for _ in range(3):
            plan = random_plan(rng, len(written), [block.group for block in program.blocks], written, 0.3)
            obs, noise = inputs(policy, rng, streams)
            expected = policy.predict_action(obs, noise=noise, plan=plan)["action_pred"]
            found = episode.call(obs, noise, plan)["action_pred"]
            assert_equal_but_for_rounding(found, expected, amplified(call_terms(artifact), program.spec.sampler))
            written |= plan == Source.COMPUTE


def test_the_table_comes_back_from_the_artifact(made: Made) -> None:
    program, artifact = made[:2]
    before, after = program.spec.sampler, artifact.manifest.spec.sampler
    assert after.memories == before.memories > 0
    for name in (*SamplerTable.COLUMNS, "timesteps", "memory_to_next", "to_memory"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_flops_of_the_update() -> None:
    """The product's own: ``2 R' (1 + S) T^2 D``, where a sampler's own column of the clip is not counted."""
    plain = toy_program().spec.sampler
    assert update_flops(plain, (16, 2)) == correction_flops((16, 2)) == 2 * 6 * 16 * 16 * 2
    assert update_flops(TABLES["dpmsolver++"], (16, 2)) == 2 * 7 * 2 * 16 * 16 * 2
    assert update_flops(TABLES["rk4"], (16, 2)) == 2 * 8 * 3 * 16 * 16 * 2


def test_noise_of_a_deterministic_sampler_is_not_read(made: Made) -> None:
    _, artifact, _, _ = made
    rng = np.random.default_rng(3)
    obs, noise = random_inputs(artifact, rng, 1)
    runtime = open_runtime(artifact)
    plan = np.zeros((artifact.manifest.steps, len(artifact.manifest.blocks)), np.int8)
    assert noise.steps is not None
    one, _ = runtime.predict(obs, noise, Plan(cells=plan))
    other, _ = runtime.predict(obs, Noise(noise.initial, 2 * noise.steps), Plan(cells=plan))
    assert np.array_equal(one, other) != artifact.manifest.spec.sampler.stochastic


@pytest.mark.slow
def test_calibration_runs_the_same_loop_and_its_corrections_help(made: Made) -> None:
    """Batches of plans and calls, and corrections fitted step by step: the memories go along with the samples."""
    artifact, rng = made[1], np.random.default_rng(4)
    runner, count, table = Runner(view_of(artifact, "dense")), 240, artifact.manifest.spec.sampler
    obs, noise = random_inputs(artifact, rng, count)
    initial, steps = noise_tensors(noise, artifact.manifest.spec.sampler.stochastic)
    with torch.no_grad():
        contexts = runner.model.prologue({"obs": torch.from_numpy(obs["obs"])})
    calls = Calls(contexts, initial, steps, np.zeros(count, np.int64))
    calls = replace(calls, path=runner.run_dense(calls))
    plan = np.full((runner.model.steps, runner.model.blocks), T, np.int8)
    plan[[0, 3]] = C
    corrected = runner.corrected(fit_correction(runner, plan, calls, True))
    for each in (runner, corrected):
        with torch.no_grad(), Counted() as counted:
            expected = runner.model.denoise(contexts, initial, steps, plan, correction=each.correction)
        assert_equal_but_for_rounding(each.run(plan, calls), expected.sample, amplified(counted.terms, table))
        if each.correction is None:
            assert_equal_but_for_rounding(
                each.run(0 * plan, calls), calls.targets, amplified(call_terms(artifact), table)
            )
    errors = [float((each.run(plan, calls) - calls.targets).abs().mean()) for each in (runner, corrected)]
    assert errors[1] < 0.8 * errors[0]
