"""``lower``: the same numbers in onnxruntime, at any batch size."""

import re
from dataclasses import replace
from typing import Any

import pytest
import torch
from onnx import helper

from tests.lower.modules import ALL, TOKENS, WIDTH, captured, random_values, spec, table
from tests.lower.sessions import lower_graph, run, session
from tests.passes.graphs import Builder
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.errors import LoweringError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Batch, Graph, Node, Ref, TensorType
from ttscompile.ir.pieces import LoopPiece
from ttscompile.ir.program import Pieces, Program
from ttscompile.lower.advance import fuse_advance
from ttscompile.lower.onnx_model import live_nodes
from ttscompile.lower.program import OPSET, lower_program, structural_key

B = Batch()


def assert_parity(graph: Graph, weights: dict[str, torch.Tensor]) -> None:
    """The model gives what the graph means, at several batch sizes in one session."""
    model = lower_graph(graph, "piece")
    running = session(model, weights)
    for streams in (1, 2, 5):
        inputs = random_values(graph.inputs, streams)
        results = running.run(list(graph.outputs), {n: v.numpy() for n, v in inputs.items()})
        with Counted() as counted:
            wanted = evaluate(graph, weights, inputs)
        for result, expected in zip(results, wanted, strict=True):
            assert_equal_but_for_rounding(result, expected, counted.terms)


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_parity(name: str) -> None:
    _, graph, weights = captured(name)
    assert_parity(graph, weights)


@pytest.mark.slow
def test_heads_are_left_where_they_are() -> None:
    _, graph, _ = captured("SelfAttention")
    operations = [node.op_type for node in lower_graph(graph, "p").graph.node]
    assert operations.count("Attention") == 1 and "Transpose" not in operations and "MatMul" not in operations
    # Here the keys are concatenated heads, which no transposition made: nothing to remove.
    _, graph, _ = captured("TwoBranches")
    attention = next(node for node in lower_graph(graph, "p").graph.node if node.op_type == "Attention")
    assert "q_num_heads" not in {attribute.name for attribute in attention.attribute}


def test_a_model_holds_operations_and_names_and_nothing_else() -> None:
    _, graph, weights = captured("SelfAttention")
    model = lower_graph(graph, "block_07")
    assert [value.name for value in model.graph.input] == list(graph.inputs)
    assert [value.name for value in model.graph.output] == list(graph.outputs)
    assert [d.dim_param or d.dim_value for d in model.graph.input[0].type.tensor_type.shape.dim] == ["B", TOKENS, WIDTH]
    by_name = {tensor.name: tensor for tensor in model.graph.initializer}
    assert set(by_name) >= set(weights)
    assert not any(by_name[name].raw_data or by_name[name].external_data for name in weights)
    assert all(tensor.raw_data for name, tensor in by_name.items() if name not in weights)
    assert [(o.domain, o.version) for o in model.opset_import] == [("", OPSET)]
    assert not model.metadata_props and not model.doc_string and not model.functions
    assert not model.graph.metadata_props and not model.graph.value_info and not model.graph.doc_string
    assert [node.name for node in model.graph.node] == [f"n{i}" for i in range(len(model.graph.node))]
    assert not any(node.doc_string or node.metadata_props for node in model.graph.node)
    data = model.SerializeToString()
    texts = re.findall(rb"[ -~]{4,}", data)
    assert not [text for text in texts if b".py" in text or b"/" in text or b"aten" in text]
    assert "Shape" not in {node.op_type for node in model.graph.node}  # shapes are known but for the batch


@pytest.mark.slow
def test_sequence_first_inputs_and_multiples_of_the_batch() -> None:
    build = Builder()
    x, heads = build.input("x", 5, B, 8), build.input("heads", Batch(4), 5, 2)
    flat = build.op("flat", "reshape.default", (5, Batch(4), 2), x, (5, Batch(4), 2))
    left = build.op("left", "transpose.int", (Batch(4), 5, 2), flat, 0, 1)
    right = build.op("right", "transpose.int", (Batch(4), 2, 5), heads, 1, 2)
    mixed = build.op("mixed", "matmul.default", (Batch(4), 5, 5), left, right)
    zeros = build.op("zeros", "zeros.default", (Batch(4), 5, 1), (Batch(4), 5, 1))
    out = build.op("out", "cat.default", (Batch(4), 5, 6), (mixed, zeros), -1)
    assert_parity(build.graph(out), {})


def test_batch_from_a_multiple_only() -> None:
    build = Builder()
    x = build.input("x", Batch(3), 2)
    ones = build.op("ones", "ones.default", (B, 2), (B, 2))
    view = build.op("view", "reshape.default", (B, 3, 2), x, (B, 3, 2))
    total = build.op("total", "sum.dim_IntList", (B, 2), view, (1,))
    assert_parity(build.graph(build.op("y", "sub.Tensor", (B, 2), total, ones)), {})


def test_no_batch_at_all() -> None:
    build = Builder()
    y = build.op("y", "linear.default", (3, 4), build.input("x", 3, 4), build.constant("w", 4, 4))
    assert_parity(build.graph(y), {"w": torch.randn(4, 4)})


def test_outputs_that_nothing_computes() -> None:
    type_ = TensorType((B, 2), "float32")
    nodes = (Node("y", "aten.clone.default", (Ref("x"),), (), (type_,)),)
    graph = Graph({"x": type_, "unused": type_}, {"w": TensorType((2,), "float32")}, nodes, ("x", "y", "w"))
    assert_parity(graph, {"w": torch.randn(2)})


def test_expansion_over_streams() -> None:
    build = Builder()
    x, token = build.input("x", B, 3), build.constant("token", 1, 3)
    wide = build.op("wide", "expand.default", (B, 3), token, (B, 3))
    same = build.op("same", "expand.default", (2, B, 3), x, (2, B, -1))
    assert_parity(build.graph(build.op("y", "mul.Tensor", (2, B, 3), same, wide)), {"token": torch.randn(1, 3)})


def feed_forward(index: int, hidden: int) -> LoopPiece:
    build = Builder()
    x, shift = build.input(f"a{index}", B, TOKENS, WIDTH), build.input(f"table{index}", 1, WIDTH)
    h = build.op(f"add{index}", "add.Tensor", (B, TOKENS, WIDTH), x, shift)
    up = build.constant(f"layers.{index}.up", hidden, WIDTH)
    h = build.op(f"up{index}", "linear.default", (B, TOKENS, hidden), h, up)
    h = build.op(f"gelu{index}", "gelu.default", (B, TOKENS, hidden), h)
    down = build.constant(f"layers.{index}.down", WIDTH, hidden)
    return LoopPiece(build.graph(build.op(f"down{index}", "linear.default", (B, TOKENS, WIDTH), h, down)), f"a{index}")


def program() -> Program:
    """Two blocks of one structure, one of another; no step piece and no pruner."""
    stem, tail, condition = Builder(), Builder(), Builder()
    shape = (B, TOKENS, WIDTH)
    sample, stream, obs = stem.input("sample", *shape), tail.input("a3", *shape), condition.input("obs", B, 3, WIDTH)
    pieces = Pieces(
        condition=condition.graph(condition.op("memory", "tanh.default", (B, 3, WIDTH), obs)),
        step=None,
        stem=LoopPiece(
            stem.graph(stem.op("a0", "linear.default", shape, sample, stem.constant("embed", WIDTH, WIDTH))), "sample"
        ),
        blocks=(feed_forward(0, 32), feed_forward(1, 24), feed_forward(2, 32)),
        tail=LoopPiece(
            tail.graph(tail.op("out", "linear.default", shape, stream, tail.constant("head", WIDTH, WIDTH))), "a3"
        ),
    )
    return Program(spec(table(out_to_x0=1.0, x0_to_next=1.0)), pieces.stem.graph, {}, (), pieces)


@pytest.mark.slow
def test_program(monkeypatch: pytest.MonkeyPatch) -> None:
    exports: list[Any] = []
    original = torch.onnx.export

    def counting(*args: Any, **kwargs: Any) -> Any:
        exports.append(args[0])
        return original(*args, **kwargs)

    monkeypatch.setattr(torch.onnx, "export", counting)
    compiled = program()
    pieces = compiled.pieces
    models = lower_program(compiled)
    assert list(models) == ["condition", "stem", "block_00", "block_01", "block_02", "advance", "blocks", "dense_step"]
    (export,) = exports  # of everything at once
    linear = [node for node in export.graph.nodes if node.target is torch.ops.aten.linear.default]
    assert len(linear) == 7  # stem, 2 in block_00, 2 in block_01, tail and stem; block_02 is block_00 with other names
    graphs = dict(zip(models, pieces.graphs().values(), strict=False))
    graphs["advance"] = fuse_advance(pieces.tail, pieces.stem, compiled.spec)
    for name, graph in graphs.items():
        assert models[name].graph.name == name
        weights = random_values(graph.constants, 1, seed=len(name))
        inputs = random_values(graph.inputs, 2)
        with Counted() as counted:
            wanted = evaluate(graph, weights, inputs)
        for result, expected in zip(run(models[name], weights, inputs), wanted, strict=True):
            assert_equal_but_for_rounding(result, expected, counted.terms)


def test_what_an_operation_leaves_out_is_no_value_of_another() -> None:
    """All pieces are exported as one model; the last state of a GRU in one is not what a Clip in another reads."""
    last_state = helper.make_node("GRU", ["frames", "inner", "outer"], ["", "state"])
    clamped = helper.make_node("Clip", ["values", "", "most"], ["result"])
    assert live_nodes([last_state, clamped], {"result"}) == [clamped]


def test_structure_is_all_but_names() -> None:
    first, other, second = (piece.graph for piece in program().pieces.blocks)
    assert structural_key(first) == structural_key(second) != structural_key(other)
    neg = TensorType((2,), "float32")
    keys = {
        structural_key(Graph({"x": neg}, {}, (Node("y", "aten.add.Scalar", (Ref("x"), number), (), (neg,)),), ("y",)))
        for number in (1, 1.0, True)
    }
    assert len(keys) == 3  # 1 == 1.0 == True, and yet they are different programs


@pytest.mark.slow
def test_what_cannot_be_lowered() -> None:
    type_, vector = TensorType((2, 2), "float32"), TensorType((2,), "float32")
    nodes = (
        Node("y", "aten.linalg_eigh.default", (Ref("x"),), (), (vector, type_)),
        Node("z", "getitem", (Ref("y"), 0), (), (vector,)),
    )
    with pytest.raises(LoweringError, match=r"piece 'block_03' could not be exported.*No ONNX function.*linalg_eigh"):
        lower_graph(Graph({"x": type_}, {}, nodes, ("z",)), "block_03")
    broken = program()
    condition = Graph({"x": type_}, {}, nodes, ("z",))
    broken = replace(broken, pieces=replace(broken.pieces, condition=condition, blocks=broken.pieces.blocks[:1]))
    with pytest.raises(LoweringError, match=r"piece 'condition' could not be exported"):  # named among all pieces
        lower_program(broken)
    with pytest.raises(LoweringError, match="twice"):
        lower_graph(Graph({"x": type_}, {}, (), ("x", "x")), "stem")
    with pytest.raises(TypeError, match="'blocks' and 'pieces'"):
        lower_program(Program(spec(), Graph({}, {}, (), ()), {}))  # type: ignore[call-arg]
