"""The runtime on torch where there is a GPU: it agrees with the reference, and what it captures is replayed.

Nothing of this runs without one. ``test_torch`` replays recordings of the same lines on the CPU.
"""

import gc
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.families import cameras
from tests.rounding import FLOAT32, assert_equal_but_for_rounding, bound
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import DENSE, Plan
from ttscompile.runtimes import Runtime, open_runtime
from ttscompile.runtimes.random_calls import normalized, random_call
from ttscompile.samplers.flow import flow_matching_table

from .agreement import assert_alike, call_terms, largest_difference, random_inputs
from .conftest import MakeArtifact
from .pruners import calibrated as with_pruner, scheduled
from .toys import toy_program, written_artifact

DEVICE = "cuda"

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch has no CUDA device here")

VARIANTS = [{}, {"noise": 0.0, "steps": 8}, {"steps": 1}, {"blocks": 1}, {"normed": True, "sequence_first": True}]


def both(artifact: Artifact) -> tuple[Runtime, Runtime]:
    return open_runtime(artifact, "torch", device=DEVICE), open_runtime(artifact, "reference")


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_it_agrees_with_the_reference(make_artifact: MakeArtifact, variant: dict[str, Any]) -> None:
    """Batches of one to four streams, each with a plan of its own or all with the same."""
    artifact = make_artifact(toy_program(**variant, pruner=False))
    runtimes, allowed = both(artifact), bound(call_terms(artifact))
    for seed in range(5):
        rng = np.random.default_rng(seed)
        assert largest_difference(artifact, *runtimes, rng, streams=1 + seed % 4, calls=4) < allowed


@pytest.fixture(scope="module")
def artifact(tmp_path_factory: pytest.TempPathFactory) -> Artifact:
    return scheduled(written_artifact(toy_program(normed=True), tmp_path_factory.mktemp("cuda") / "artifact"))


@pytest.mark.parametrize("name", ["evenly", "mixed", DENSE])
def test_a_call_is_replayed_on_other_inputs_and_batches(artifact: Artifact, name: str) -> None:
    runtimes, rng = both(artifact), np.random.default_rng(0)
    for streams in (1, 3, 1):
        for runtime in runtimes:
            runtime.reset()
        for called in (DENSE, name, name, name):
            assert_alike(artifact, runtimes, artifact.plans[called], rng, streams, times=2)


def test_what_was_committed_is_kept(make_artifact: MakeArtifact) -> None:
    program = toy_program(8, 4, pruner=False, normed=True, horizon=6)
    artifact = make_artifact(replace(program, spec=replace(program.spec, sampler=flow_matching_table(8))))
    runtimes, rng = both(artifact), np.random.default_rng(0)
    sparse = Plan(cells=uniform_plan(8, 4, 3))
    for plan, length in ((artifact.plans[DENSE], 1), (sparse, 3), (artifact.plans[DENSE], 3)):
        prefix = rng.standard_normal((1, length, artifact.manifest.spec.chunk.action_dim), dtype=np.float32)
        assert_alike(artifact, runtimes, plan, rng, times=2, prefix=prefix)


def test_the_pruner_decides(tmp_path: Path) -> None:
    program = toy_program(normed=True)
    made = written_artifact(program, tmp_path / "pruned")
    artifact, rng = load_artifact(with_pruner(made.path, program)), np.random.default_rng(0)
    runtimes, seen = both(artifact), set()
    for _ in range(6):
        obs, noise = random_inputs(artifact, rng, 2)
        found = [runtime.predict(obs, noise, artifact.plans["pruner"]) for runtime in runtimes]
        np.testing.assert_array_equal(found[0][1].plan, found[1][1].plan)
        assert_equal_but_for_rounding(found[0][0], found[1][0], 2 * call_terms(artifact))
        seen.add(found[0][1].plan.tobytes())
    assert len(seen) > 1


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_products_in_fewer_bits_are_near_those_in_fp32(artifact: Artifact, precision: str) -> None:
    runtime, rng = open_runtime(artifact, "torch", device=DEVICE), np.random.default_rng(0)
    unit = {"bf16": 2.0**-8, "fp16": 2.0**-11}[precision]
    for _ in range(2):
        obs, noise = random_inputs(artifact, rng, 2)
        exact, narrow = (runtime.predict(obs, noise, artifact.plan(n))[0] for n in (DENSE, f"{DENSE}@{precision}"))
        difference = np.abs(narrow - exact).max() / np.abs(exact).max()
        assert bound(1) < difference < bound(call_terms(artifact), unit=unit)


def test_what_torch_was_told_about_precision_changes_no_action(artifact: Artifact) -> None:
    obs, noise = random_inputs(artifact, np.random.default_rng(0), 2)
    runtime = open_runtime(artifact, "torch", device=DEVICE)
    expected = runtime.predict(obs, noise, artifact.plans[DENSE])[0]
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        found = open_runtime(artifact, "torch", device=DEVICE).predict(obs, noise, artifact.plans[DENSE])[0]
        again = runtime.predict(obs, noise, Plan(cells=artifact.plans[DENSE].cells))[0]
    finally:
        torch.set_float32_matmul_precision(before)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(again, expected)


def test_frames_are_encoded(tmp_path: Path) -> None:
    cameras.compile_seeing(tmp_path)
    artifact = load_artifact(tmp_path / "artifact")
    spec, runtimes = artifact.manifest.spec, both(artifact)
    for number in range(2):
        obs, noise = random_call(spec, number, 8)
        ours, theirs = (one.predict(normalized(spec, obs), noise, artifact.plans[DENSE])[0] for one in runtimes)
        assert_equal_but_for_rounding(ours, theirs, call_terms(artifact))


def test_the_module_moves_there(artifact: Artifact) -> None:
    module = ttscompile.to_module(artifact.path, "evenly").to(DEVICE)
    obs, noise = random_call(artifact.manifest.spec, 0, 8)
    given = {key: torch.from_numpy(value).to(DEVICE) for key, value in obs.items()}
    steps = None if noise.steps is None else torch.from_numpy(noise.steps).to(DEVICE)
    found = module(given, torch.from_numpy(noise.initial).to(DEVICE), steps).cpu()
    expected = ttscompile.load(artifact.path, "reference").predict_action(obs, noise=noise, plan="evenly")
    assert_equal_but_for_rounding(found, expected["action_pred"], 4 * call_terms(artifact))


def test_a_call_is_captured_while_another_thread_computes(artifact: Artifact) -> None:
    """As the executor does, beside a program of its user's that has the GPU, too, and draws no numbers there."""
    stop, failed = threading.Event(), list[Exception]()

    def other() -> None:
        numbers = torch.ones(64, 64, device=DEVICE)  # torch lets no thread draw some while another captures
        try:
            while not stop.is_set():
                numbers.matmul(numbers).cpu()
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=other)
    thread.start()
    try:
        runtimes, rng = both(artifact), np.random.default_rng(0)
        for name in (DENSE, "evenly", "mixed", DENSE):
            assert_alike(artifact, runtimes, artifact.plans[name], rng, 2, times=2)
    finally:
        stop.set()
        thread.join()
    assert not failed


def test_a_policy_goes_and_another_comes(artifact: Artifact, make_artifact: MakeArtifact) -> None:
    """What was captured is let go with its policy, and takes no memory of the next one with it."""
    other = make_artifact(toy_program(8, 4, normed=True))
    for one in (artifact, other, artifact, other):
        runtimes, rng = both(one), np.random.default_rng(0)
        for name, unit in ((DENSE, FLOAT32), (DENSE, FLOAT32), (f"{DENSE}@bf16", 2.0**-8)):
            assert_alike(one, runtimes, one.plan(name), rng, 2, times=2, unit=unit)
        del runtimes
        gc.collect()


def test_what_comes_again_is_replayed(artifact: Artifact) -> None:
    """A matrix of the caller's runs as it is, is captured, and is replayed; so is a plan in another precision."""
    runtimes, rng = both(artifact), np.random.default_rng(0)
    matrix = Plan(cells=uniform_plan(artifact.manifest.steps, len(artifact.manifest.groups), 3))
    for _ in range(4):
        for plan, unit in ((matrix, FLOAT32), (artifact.plan("evenly@bf16"), 2.0**-8)):
            assert_alike(artifact, runtimes, plan, rng, times=2, unit=unit)


def test_scratch_memory_that_somebody_frees_is_not_the_graphs(artifact: Artifact) -> None:
    """As torch.compile does it with CUDA graphs of its own; another number of streams is captured after it, too."""
    runtimes, rng = both(artifact), np.random.default_rng(0)
    for streams in (1, 2, 1):
        for runtime in runtimes:
            runtime.reset()
        for _ in range(3):
            torch._C._cuda_clearCublasWorkspaces()
            torch.cuda.empty_cache()
            taken = torch.full((2**22,), np.nan, device=DEVICE)  # where that memory was
            assert_alike(artifact, runtimes, artifact.plans["evenly"], rng, streams, times=2)
            assert bool(taken.isnan().all())
