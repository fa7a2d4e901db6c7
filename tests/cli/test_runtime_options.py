"""The runtime and its device, as commands take them."""

from pathlib import Path

import pytest

from tests.commands import as_json, refused, run


def test_bench_times_torch_beside_the_same_plan_in_onnxruntime(toy_compiled: Path) -> None:
    options = ("--runtime", "torch,onnxruntime", "--device", "cpu")
    told = as_json("bench", toy_compiled, *options, "--calls", 2, "--plan", "dense")
    assert (told["runtime"], told["device"]) == (["torch", "onnxruntime"], "cpu")
    contestants = [(each["label"], each["plan"]) for each in told["contestants"]]
    assert contestants == [("dense, torch on cpu", "dense"), ("dense, onnxruntime", "dense")]


def test_bench_times_a_plan_in_fewer_bits_on_torch(toy_compiled: Path) -> None:
    options = ("--runtime", "torch", "--device", "cpu", "--plan", "dense@bf16")
    told = as_json("bench", toy_compiled, *options, "--calls", 2)
    assert (told["runtime"], told["device"]) == (["torch"], "cpu")
    contestants = [(each["label"], each["plan"]) for each in told["contestants"]]
    assert contestants == [("dense, torch on cpu", "dense"), ("dense@bf16, torch on cpu", "dense@bf16")]
    shown = run("bench", toy_compiled, *options, "--calls", 1, "--control-hz", 10)
    assert shown.exit_code in (0, 1), shown.stderr  # the machine may be busy
    assert "dense@bf16, torch on cpu: " in " ".join(shown.stdout.split())


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
    assert message in refused(command, toy_compiled, *options)
