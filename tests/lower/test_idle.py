"""What idle steps need of a total: exact where stem and tail have the form, and no model where they almost have it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.rounding import Counted, assert_equal_but_for_rounding
from tests.runtimes.toys import B, f32, node, toy_program
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Graph, Node, Ref, TensorType
from ttscompile.ir.pieces import IDLE_OUTPUTS, TOTAL, LoopPiece
from ttscompile.ir.program import Pieces, Program
from ttscompile.lower.advance import lower_idle
from ttscompile.lower.program import OPSET

from .sessions import session

STREAM, SAMPLE = f32(B, 3, 4), f32(B, 3, 2)
WEIGHTS = {"mix": f32(3, 3), "position": f32(3, 4), "scale": f32(3, 1), "norm.w": f32(4), "norm.b": f32(4)}


def values_of(program: Program) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    more = {name: rng.standard_normal(type_.at(1)).astype(np.float32) for name, type_ in WEIGHTS.items()}
    return {**more, **{name: np.asarray(value) for name, value in program.weights.items()}}


def product_of(pieces: Pieces, weights: dict[str, np.ndarray], size: float = 1.0) -> np.ndarray:
    """Compare the model's prediction with the tail's, for a total of this size; gives what multiplies the sample."""
    model, why = lower_idle(pieces, weights, OPSET)
    assert model is not None and not why, why
    rng = np.random.default_rng(0)
    x = rng.standard_normal((5, 3, 2)).astype(np.float32)
    total = (size * rng.standard_normal(pieces.tail.type.at(5))).astype(np.float32)
    base, product, shift = session(model, {}).run(list(IDLE_OUTPUTS), {TOTAL: total})
    y = np.einsum("ed,dbt->ebt", product, x.transpose(2, 0, 1)) + base
    found = y[3:] / np.sqrt((y[:3] ** 2).sum(axis=0)) + shift
    tensors = {name: torch.from_numpy(value) for name, value in weights.items()}
    stream = evaluate(pieces.stem.graph, tensors, {"sample": torch.from_numpy(x)})[0] + torch.from_numpy(total)
    with Counted() as counted:
        expected = evaluate(pieces.tail.graph, tensors, {pieces.tail.stream: stream})[0]
    # The norm is taken apart: base and product are rounded before they are added, and so is the shift.
    assert_equal_but_for_rounding(found, expected.numpy().transpose(2, 0, 1), 4 * max(counted.terms, 1))
    return np.asarray(product)


@pytest.mark.parametrize("sequence_first", [False, True])
@pytest.mark.parametrize("size", [1e-3, 1.0, 300.0])
def test_the_prediction_is_the_tails(sequence_first: bool, size: float) -> None:
    program = toy_program(normed=True, sequence_first=sequence_first)
    assert product_of(program.pieces, values_of(program), size).any()


def tail(*nodes: Node, **constants: TensorType) -> LoopPiece:
    return LoopPiece(Graph({"h": STREAM}, {"tail.w": f32(2, 4), **constants}, nodes, ("out",)), "h")


NORM = node("n", "layer_norm.default", STREAM, Ref("h"), (4,), None, None, 1e-5, False)


def head_of(value: str) -> Node:
    return node("out", "linear.default", SAMPLE, Ref(value), Ref("tail.w"))


LIFT = node("l", "linear.default", STREAM, Ref("sample"), Ref("stem.w"))


def stem(*nodes: Node, **constants: TensorType) -> LoopPiece:
    result = ("h0" if nodes else "l",)
    return LoopPiece(Graph({"sample": SAMPLE}, {"stem.w": f32(4, 2), **constants}, (LIFT, *nodes), result), "sample")


def reads_a_context() -> LoopPiece:
    graph = tail(NORM, head_of("n")).graph
    return LoopPiece(replace(graph, inputs={**graph.inputs, "c": f32(B, 1, 4)}), "h")


@pytest.mark.parametrize("carried", [False, True], ids=["of the stream", "beside the sample"])
def test_an_affine_tail_has_the_form(carried: bool) -> None:
    """Where the stream carries the sample beside the prediction (``OneBlock``), the prediction is the total's alone."""
    program = toy_program(normed=True)
    pieces, weights = program.pieces, values_of(program)
    if carried:
        padded = node("h0", "constant_pad_nd.default", STREAM, Ref("sample"), (0, 2), 0.0)
        beside = LoopPiece(Graph({"sample": SAMPLE}, {}, (padded,), ("h0",)), "sample")
        taken = LoopPiece(
            Graph({"h": STREAM}, {}, (node("out", "slice.Tensor", SAMPLE, Ref("h"), 2, 2, 4),), ("out",)), "h"
        )
        pieces = replace(pieces, stem=beside, tail=taken)
    else:
        pieces = replace(pieces, tail=tail(head_of("h")))
    assert product_of(pieces, weights).any() == (not carried)


def test_a_norm_without_weights_and_a_stem_with_positions_have_the_form() -> None:
    program = toy_program(normed=True)
    moved = stem(node("h0", "add.Tensor", STREAM, Ref("l"), Ref("position")), position=f32(3, 4))
    pieces = replace(program.pieces, stem=moved, tail=tail(NORM, head_of("n")))
    assert lower_idle(pieces, values_of(program), OPSET)[0] is not None


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"stem": stem(node("h0", "tanh.default", STREAM, Ref("l")))}, "not known to be affine"),
        ({"stem": stem(node("h0", "mul.Tensor", STREAM, Ref("l"), Ref("l")))}, "not known to be affine"),
        (
            {"stem": stem(node("h0", "matmul.default", STREAM, Ref("mix"), Ref("l")), mix=f32(3, 3))},
            "every token of sample alike",
        ),
        (
            {"stem": stem(node("h0", "mul.Tensor", STREAM, Ref("l"), Ref("scale")), scale=f32(3, 1))},
            "every token of sample alike",
        ),
        ({"tail": tail(node("g", "gelu.default", STREAM, Ref("h")), head_of("g"))}, "not known to be affine"),
        ({"tail": tail(NORM, node("g", "gelu.default", STREAM, Ref("n")), head_of("g"))}, "not known to be affine"),
        (
            {"tail": tail(NORM, node("s", "add.Tensor", STREAM, Ref("n"), Ref("h")), head_of("s"))},
            "does not begin with a LayerNorm",
        ),
        (
            {
                "tail": tail(
                    node("n", "layer_norm.default", STREAM, Ref("h"), (3, 4), None, None, 1e-5, False), head_of("n")
                )
            },
            "is not over the 4 numbers",
        ),
        ({"tail": reads_a_context()}, "values of the observation or the step"),
    ],
)
def test_near_misses_have_no_model(change: dict[str, Any], why: str) -> None:
    program = toy_program(normed=True)
    pieces = replace(program.pieces, **change)
    model, reason = lower_idle(pieces, values_of(program), OPSET)
    assert model is None
    assert why in reason
