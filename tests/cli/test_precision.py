"""``convert --precision``: what the command says about it, and what it refuses."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.commands import as_json, done, refused
from ttscompile import Noise
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.contestants import Way, contestants
from ttscompile.runtimes.random_calls import random_calls
from ttscompile.verification.precision import EIGHT_BITS

STEPS = 4


@pytest.fixture(scope="module")
def converted(one_layer_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A layer of the Push-T policy with eight-bit weights and few steps, and what the command said."""
    directory = tmp_path_factory.mktemp("int8") / "compiled"
    options = ("--sampler", "ddim", "--steps", STEPS, "--precision", "int8", "--json")
    result = done("convert", one_layer_checkpoint, "-o", directory, *options)
    assert "precision: int8 in blocks\n" in result.stderr
    return directory, json.loads(result.stdout)


@pytest.mark.slow
def test_convert_and_inspect_say_the_precision(converted: tuple[Path, dict[str, Any]]) -> None:
    directory, told = converted
    stage = next(stage for stage in told.pop("stages") if stage["stage"] == "lower_precision")
    assert stage["notes"][0].startswith("int8: 6 matrices of 3 of 3 blocks")
    assert stage["notes"][1].startswith("condition stays fp32: ") and "of a step" in stage["notes"][1]
    assert as_json("inspect", directory) == told
    record = told["precision"]
    assert (record["name"], record["blocks"]) == ("int8", 3)
    assert (record["parts"], record["asked"]) == (["blocks"], [])
    assert 0.85e5 < record["bytes"] < 1.0e5  # 2.6e5 in fp32
    text = " ".join(done("inspect", directory).stdout.split())
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
    told = as_json("inspect", toy_compiled)
    assert told["precision"] == {"name": "fp32", "blocks": 0, "bytes": 0, "parts": [], "asked": []}
    assert "fp32" in done("inspect", toy_compiled).stdout


@pytest.mark.parametrize("name", ["bf16", "int3"])
def test_a_precision_that_there_is_not_is_refused_before_the_checkpoint_is_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty.ckpt").touch()
    told = refused("convert", tmp_path / "empty.ckpt", "-o", tmp_path / "compiled", "--precision", name)
    assert f"'{name}' is not one of 'fp32', 'int8', 'int4'" in told
    assert not (tmp_path / "compiled").exists()


@pytest.mark.slow
def test_bench_times_the_dense_plan_in_fp32_and_names_the_precision(converted: tuple[Path, dict[str, Any]]) -> None:
    labels = [one["label"] for one in as_json("bench", converted[0], "--calls", 2)["contestants"]]
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
