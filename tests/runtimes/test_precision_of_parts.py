"""Eight bits in the prologue beside the blocks: part by part, as a plan says, and left out."""

import re
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

import ttscompile
from tests.families import cameras
from tests.lower.whole_call import Episode, inputs
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.manifest import Manifest
from ttscompile.artifact.view import view_of
from ttscompile.driver import transform
from ttscompile.errors import IllegalPlanError, LoweringError
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.program import Program
from ttscompile.lower import precision
from ttscompile.lower.precision import parts_to_lower
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.random_calls import random_call
from ttscompile.runtimes.single_file import inputs_of
from ttscompile.verification.precision import CARRIED, EIGHT_BITS

from . import seeing
from .agreement import largest_difference, random_inputs

LOUD = 1000.0
"""A channel of the encoder that takes all of the eight bits."""


@pytest.fixture
def int8(once: Once) -> Path:
    """The policy in eight bits, its single file beside it."""
    return seeing.compiled(once)[0]


@pytest.fixture
def program(once: Once) -> Program:
    return seeing.compiled(once)[1]


def compiled(path: Path, loud: float = 0.0, **options: object) -> tuple[Manifest, list[str]]:
    """The manifest of the policy, compiled; and what was said of its precision."""
    said: list[str] = []
    explain = lambda stage, notes: said.extend(notes if stage == "lower_precision" else ())  # noqa: E731
    ttscompile.compile_denoiser(*seeing.policy(loud), path, explain=explain, **options)  # type: ignore[arg-type]
    return load_artifact(path).manifest, said


def operations(path: Path, piece: str) -> set[str]:
    model = onnx.load(path / view_of(load_artifact(path)).onnx_file(piece), load_external_data=False)
    return {node.op_type for node in model.graph.node}


@pytest.mark.slow
def test_the_encoder_has_integer_products_and_convolutions_beside_the_blocks(int8: Path) -> None:
    found = operations(int8, "condition")
    assert {"DynamicQuantizeMatMul", "MatMulIntegerToFloat", "Conv"} <= found, "a convolution of three channels stays"
    assert "DynamicQuantizeMatMul" in operations(int8, "block_00") & operations(int8, "dense_step")
    assert "DynamicQuantizeMatMul" not in operations(int8, "stem") | operations(int8, "advance")


@pytest.mark.slow
def test_each_part_has_its_precision_from_the_plan(int8: Path) -> None:
    artifact = load_artifact(int8)
    record, dense = artifact.manifest.precision, artifact.plans["dense"]
    assert record is not None
    assert record.kept == tuple(artifact.plans["full"].precision) == ("condition", "blocks")
    assert record.told == "int8 in condition and blocks"
    runtime, spec = open_runtime(artifact, plan=dense), artifact.manifest.spec
    (obs, noise), (_, other) = (random_call(spec, number, 8) for number in (0, 1))
    exact = runtime.predict(obs, noise, dense)[0]
    runtime.reset()
    apart = np.abs(runtime.predict(obs, other, dense)[0] - exact).mean()
    samples = []
    for parts in (["condition"], ["blocks"], record.kept):
        runtime.reset()
        samples.append(runtime.predict(obs, noise, replace(dense, precision=dict.fromkeys(parts, "int8")))[0])
        assert 0 < np.abs(samples[-1] - exact).mean() < 0.1 * apart
    assert not np.array_equal(samples[0], samples[1]) and not np.array_equal(samples[1], samples[2])


def test_it_is_the_reference_within_the_tolerance_of_eight_bits_whatever_the_threads(int8: Path) -> None:
    artifact = load_artifact(int8)
    full, samples = artifact.plans["full"], []
    reference = open_runtime(artifact, "reference", plan=full.exact)
    for threads in (1, 2):
        runtime, rng = open_runtime(artifact, threads=threads), np.random.default_rng(0)
        found = largest_difference(artifact, runtime, reference, rng, 2, calls=2, base=full)
        assert 1e-5 < found < CARRIED * EIGHT_BITS, "not in eight bits, or further off than verify allows"
        obs, noise = random_inputs(artifact, np.random.default_rng(1), 2)
        for _ in range(2):
            runtime.reset()
            samples.append(runtime.predict(obs, noise, full)[0])
    assert all(np.array_equal(one, samples[0]) for one in samples), "calls repeat to the bit"
    statuses = {rung.name: rung.status for rung in ttscompile.verify(int8).rungs}
    assert "failed" not in statuses.values() and statuses["precision"] == "passed"


def test_the_single_file_computes_the_same(int8: Path) -> None:
    policy = ttscompile.load(int8)
    obs, noise = inputs(policy, np.random.default_rng(0), 2)
    found = Episode((int8.parent / "call.onnx").read_bytes(), 2).call(obs, noise, np.zeros((seeing.STEPS, 3), np.int8))
    expected = policy.predict_action(obs, noise=noise)
    np.testing.assert_allclose(found["action"], expected["action"], rtol=1e-4, atol=1e-4)
    exact = policy.predict_action(obs, noise=noise, plan="dense")
    assert np.abs(exact["action"] - expected["action"]).max() > 1e-3


def test_a_plan_in_another_precision_than_the_single_file_is_refused(int8: Path) -> None:
    """The file has the parts of ``convert`` in eight bits, and would compute it in these without a word."""
    for name in (None, "full", "dense@int8"):
        assert inputs_of(int8, name)["plan"].shape == (1, seeing.STEPS, 3)
    for name in ("dense", "full@fp32", "full@int8+blocks"):
        with pytest.raises(IllegalPlanError, match=rf"plan {re.escape(repr(name))} is .* Give '\w+@int8'"):
            inputs_of(int8, name)


def test_a_part_that_was_left_out_is_in_fp32_and_named(tmp_path: Path) -> None:
    manifest, said = compiled(tmp_path / "compiled", precision="int8", keep_fp32=("blocks",))
    record = manifest.precision
    assert record is not None
    assert (record.kept, record.asked) == (("condition",), ("blocks",))
    assert set(record.models) == {"condition"}
    assert "blocks stays fp32, as was asked" in said
    artifact = load_artifact(tmp_path / "compiled")
    assert artifact.plan("dense@int8").precision == artifact.plan("full").precision == {"condition": "int8"}
    assert inputs_of(tmp_path / "compiled", "dense@int8")["plan"].shape == (1, seeing.STEPS, 3)
    assert ttscompile.load(tmp_path / "compiled", plan="dense@int8").info.default_plan == "dense@int8"


@pytest.mark.parametrize(
    ("kept", "expected"),
    [((), ("condition", "step", "blocks")), (["condition"], ("step", "blocks")), ({"prologue"}, ("blocks",))],
)
def test_parts_stay_by_name_and_all_of_the_prologue_together(
    program: Program, kept: Collection[str], expected: tuple[str, ...]
) -> None:
    found, left, _ = parts_to_lower(program, kept)
    assert found == expected
    assert {*found, *left} == {"condition", "step", "blocks"}


def test_what_is_no_part_and_everything_cannot_stay(program: Program) -> None:
    with pytest.raises(LoweringError, match="'encoder' is no part of this policy; expected one of .*'prologue'"):
        parts_to_lower(program, ("encoder",))
    with pytest.raises(LoweringError, match="everything stays fp32: condition, step, blocks"):
        parts_to_lower(program, ("blocks", "prologue"))


def test_a_prologue_that_is_small_beside_a_step_stays_as_it_is(program: Program) -> None:
    condition = program.pieces.condition
    small = replace(condition, nodes=(), outputs=tuple(condition.inputs))
    found, left, notes = parts_to_lower(replace(program, pieces=replace(program.pieces, condition=small)))
    assert (found, left) == (("step", "blocks"), ())
    assert notes == ("condition stays fp32: 0.0% of the arithmetic of a step",)


@pytest.mark.slow
def test_a_frame_piece_counts_with_all_of_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    pieces = (seen := transform(*cameras.policy("stacked"))).pieces
    assert pieces.rows == (4,)
    row, blocks = graph_flops(pieces.towers[0]), sum(graph_flops(piece.graph) for piece in pieces.blocks)
    monkeypatch.setattr(precision, "LEAST_SHARE", 3 * row / blocks)
    assert parts_to_lower(seen)[0] == ("frame_00", "blocks")
    monkeypatch.setattr(precision, "LEAST_SHARE", 5 * row / blocks)
    assert parts_to_lower(seen)[0] == ("blocks",)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"precision": "int8", "keep_fp32": "prologue"}, "expected names of parts"),
        ({"keep_fp32": ("prologue",)}, "as does everything in precision 'fp32'"),
        ({"precision": "int3"}, "expected one of 'fp32', 'int8', 'int4'."),
    ],
)
def test_what_cannot_be_is_refused_before_any_work(tmp_path: Path, options: dict[str, object], message: str) -> None:
    with pytest.raises(LoweringError, match=message):
        ttscompile.convert(tmp_path / "missing.ckpt", tmp_path / "compiled", **options)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []
