"""``convert --precision``: what the command says about it, and what it refuses."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import ttscompile
from ttscompile import Noise
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.cli import main
from ttscompile.cli.bench import choosable, choose_again
from ttscompile.cli.contestants import Way, contestants
from ttscompile.core.lattice import uniform_plan
from ttscompile.report.timing import Measurement
from ttscompile.runtimes.random_calls import random_calls
from ttscompile.verification.precision import EIGHT_BITS

STEPS = 4


def run(*arguments: object) -> Any:
    return CliRunner().invoke(main, [str(a) for a in arguments], catch_exceptions=False)


@pytest.fixture(scope="module")
def converted(one_layer_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A layer of the Push-T policy with eight-bit weights and few steps, and what the command said."""
    directory = tmp_path_factory.mktemp("int8") / "compiled"
    options = ("--sampler", "ddim", "--steps", STEPS, "--precision", "int8", "--json")
    result = run("convert", one_layer_checkpoint, "-o", directory, *options)
    assert result.exit_code == 0, result.stderr
    assert "precision: int8 in blocks\n" in result.stderr
    return directory, json.loads(result.stdout)


@pytest.mark.slow
def test_convert_and_inspect_say_the_precision(converted: tuple[Path, dict[str, Any]]) -> None:
    directory, told = converted
    stage = next(stage for stage in told.pop("stages") if stage["stage"] == "lower_precision")
    assert stage["notes"][0].startswith("int8: 6 matrices of 3 of 3 blocks")
    assert stage["notes"][1].startswith("condition stays fp32: ") and "of a step" in stage["notes"][1]
    assert json.loads(run("inspect", directory, "--json").stdout) == told
    record = told["precision"]
    assert (record["name"], record["blocks"]) == ("int8", 3)
    assert (record["parts"], record["asked"]) == (["blocks"], [])
    assert 0.85e5 < record["bytes"] < 1.0e5  # 2.6e5 in fp32
    text = " ".join(run("inspect", directory).stdout.split())
    assert "precision int8 in blocks" in text


@pytest.mark.slow
def test_it_is_the_reference_within_the_tolerance_of_eight_bits(converted: tuple[Path, dict[str, Any]]) -> None:
    directory, _ = converted
    rng = np.random.default_rng(100)
    obs = {"obs": rng.uniform(100, 400, (1, 2, 20)).astype(np.float32)}
    noise = Noise(rng.standard_normal((1, 16, 2), dtype=np.float32))
    compiled, reference = (
        ttscompile.load(directory, runtime, plan=plan)
        for runtime, plan in (("onnxruntime", "full"), ("reference", "full@fp32"))
    )
    found, expected = (p.predict_action(obs, noise=noise)["action"] for p in (compiled, reference))
    normalizer = compiled.info.action.normalizer
    assert normalizer is not None
    largest = np.abs(normalizer.normalize(expected)).max()
    difference = np.abs(normalizer.normalize(found) - normalizer.normalize(expected)).max()
    assert 1e-5 < difference / largest < EIGHT_BITS


def test_fp32_is_the_default_and_inspect_says_so(toy_compiled: Path) -> None:
    told = json.loads(run("inspect", toy_compiled, "--json").stdout)
    assert told["precision"] == {"name": "fp32", "blocks": 0, "bytes": 0, "parts": [], "asked": []}
    assert "fp32" in run("inspect", toy_compiled).stdout


@pytest.mark.parametrize("name", ["bf16", "int3"])
def test_a_precision_that_there_is_not_is_refused_before_the_checkpoint_is_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty.ckpt").touch()
    result = run("convert", tmp_path / "empty.ckpt", "-o", tmp_path / "compiled", "--precision", name)
    assert result.exit_code == 2
    assert f"'{name}' is not one of 'fp32', 'int8', 'int4'" in " ".join(result.stderr.split())
    assert not (tmp_path / "compiled").exists()


@pytest.mark.slow
def test_bench_times_the_dense_plan_in_fp32_and_names_the_precision(converted: tuple[Path, dict[str, Any]]) -> None:
    result = run("bench", converted[0], "--calls", 2, "--json")
    labels = [contestant["label"] for contestant in json.loads(result.stdout)["contestants"]]
    assert labels == ["dense", "full, int8"]
    entered = contestants({"": load_artifact(converted[0])}, ["dense@int8", "full@fp32"], [Way()])
    assert [one.label for one in entered] == ["dense", "dense@int8", "full@fp32"]
    assert all(one.spec is entered[0].spec for one in entered)  # whose noise serves the loops of all
    ((obs, noise),) = random_calls(entered[0].spec, 1, 0)
    answers = [one.call(obs, noise)["action"] for one in entered]  # type: ignore[index]
    policy = ttscompile.load(converted[0], plan="dense")
    expected = [policy.predict_action(obs, noise=noise, plan=one)["action"] for one in ("dense", "full@fp32")]
    np.testing.assert_array_equal(answers[0], expected[0])
    assert not np.array_equal(answers[1], expected[0])
    np.testing.assert_array_equal(answers[2], expected[1])


@pytest.mark.slow
def test_a_machine_that_is_faster_in_fp32_gets_the_default_in_fp32(
    converted: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    directory = shutil.copytree(converted[0], tmp_path / "compiled")
    full = load_artifact(directory).plans["full"]
    plan = replace(full, cells=uniform_plan(STEPS, 3, 2))
    score = {"distance": 0.05, "interval": [0.0, 0.06], "sparsity": 0.5, "flops_saved": 0.5}
    update_plans(directory, {"full": full, "schedule": plan}, "schedule", {"plans": {"schedule": score}})
    artifact = load_artifact(directory)
    assert list(choosable(artifact)) == ["schedule", "schedule@fp32"]
    times = [Measurement(name, name, (took,)) for name, took in (("schedule", 3.0), ("schedule@fp32", 1.0))]
    told = choose_again(directory, artifact, times, None, 1)
    assert told == "The default is 'schedule', in fp32. schedule 3 ms, schedule@fp32 1 ms."
    after = load_artifact(directory)
    assert (after.manifest.default_plan, dict(after.default.precision)) == ("schedule", {})
    assert after.manifest.identity != artifact.manifest.identity
    obs, noise = random_calls(after.manifest.spec, 1, 0)[0]
    found = ttscompile.load(directory).predict_action(obs, noise=noise)["action"]
    before = ttscompile.load(converted[0]).predict_action(obs, noise=noise, plan=replace(plan, precision={}))["action"]
    np.testing.assert_array_equal(found, before)
