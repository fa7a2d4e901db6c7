"""The runtime and its device, as commands take them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from ttscompile.cli import main


def run(*arguments: object) -> Any:
    return CliRunner().invoke(main, [str(a) for a in arguments], catch_exceptions=False)


def test_bench_times_torch_beside_the_same_plan_in_onnxruntime(toy_compiled: Path) -> None:
    options = ("--runtime", "torch,onnxruntime", "--device", "cpu")
    result = run("bench", toy_compiled, *options, "--calls", 2, "--plan", "dense", "--json")
    assert result.exit_code == 0, result.stderr
    told = json.loads(result.stdout)
    assert (told["runtime"], told["device"]) == (["torch", "onnxruntime"], "cpu")
    contestants = [(each["label"], each["plan"]) for each in told["contestants"]]
    assert contestants == [("dense, torch on cpu", "dense"), ("dense, onnxruntime", "dense")]


def test_bench_times_a_plan_in_fewer_bits_on_torch(toy_compiled: Path) -> None:
    options = ("--runtime", "torch", "--device", "cpu", "--plan", "dense@bf16")
    result = run("bench", toy_compiled, *options, "--calls", 2, "--json")
    assert result.exit_code == 0, result.stderr
    told = json.loads(result.stdout)
    assert (told["runtime"], told["device"]) == (["torch"], "cpu")
    contestants = [(each["label"], each["plan"]) for each in told["contestants"]]
    assert contestants == [("dense, torch on cpu", "dense"), ("dense@bf16, torch on cpu", "dense@bf16")]
    shown = run("bench", toy_compiled, *options, "--calls", 1, "--control-hz", 10)
    assert "dense@bf16, torch on cpu: " in " ".join(shown.stdout.split())


def test_a_loop_is_judged_on_torch(toy_compiled: Path) -> None:
    result = run("bench", toy_compiled, "--control-hz", 10, "--calls", 1, "--plan", "dense", "--runtime", "torch")
    assert result.exit_code in (0, 1), result.stderr  # the machine may be busy
    assert "dense" in result.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("bench", "--device", "cuda"), "runtime 'onnxruntime' computes on the CPU alone; found device 'cuda'"),
        (("bench", "--runtime", "torch", "--device", "abacus"), "device 'abacus' cannot be had"),
        (("bench", "--runtime", "torch", "--plan", "dense@int8"), "the plan wants 'blocks' in 'int8'"),
        (("bench", "--plan", "dense@bf16"), "the plan wants 'blocks' in 'bf16'"),
        (("bench", "--plan", "dense@fp4"), "has no plan 'dense@fp4'"),
        (("bench", "--runtime", "tensorrt"), "'tensorrt' is not one of onnxruntime, torch"),
        (("calibrate", "--trajectories", "CALLS", "--device", "abacus"), "device 'abacus' cannot be had"),
    ],
)
def test_what_cannot_be_had_is_bad_usage(
    toy_compiled: Path, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    calls = tmp_path / "calls.npz"
    calls.write_bytes(b"")
    command, *options = (str(calls) if word == "CALLS" else word for word in words)
    result = run(command, toy_compiled, *options)
    assert (result.exit_code, result.stdout) == (2, "")
    assert message in " ".join(result.stderr.split())
    assert "Traceback" not in result.stderr
