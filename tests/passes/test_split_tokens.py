"""Token splitting: what is token-wise moves above the concatenation, what is not stays below it."""

from collections.abc import Callable

import pytest
import torch

from tests.passes.graphs import B, Builder
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Graph, Ref
from ttscompile.ir.program import Binding
from ttscompile.ir.verify import verify_graph
from ttscompile.passes.split_tokens import _Splitter

INPUTS = {"time": Binding.TABLE, "obs": Binding.CONDITION}


def tokens() -> tuple[Builder, Ref]:
    """One time token and two observation tokens, joined."""
    b = Builder()
    time, obs = b.input("time", B, 1, 8), b.input("obs", B, 2, 8)
    return b, b.op("tokens", "cat.default", (B, 3, 8), (time, obs), 1)


def split(graph: Graph) -> tuple[Graph, _Splitter]:
    splitter = _Splitter(graph, INPUTS)
    result = splitter.run()
    verify_graph(result, "split")
    return result, splitter


def assert_same(graph: Graph, result: Graph) -> None:
    draw = torch.Generator().manual_seed(0)
    values = {n: torch.randn(t.at(2), generator=draw) for n, t in {**graph.inputs, **graph.constants}.items()}
    weights = {n: values[n] for n in graph.constants}
    inputs = {n: values[n] for n in graph.inputs}
    with Counted() as counted:
        expected = evaluate(graph, weights, inputs)
    for before, after in zip(expected, evaluate(result, weights, inputs), strict=True):
        assert_equal_but_for_rounding(after, before, counted.terms)


def last(graph: Graph) -> str:
    return graph.producers()[graph.outputs[0]].op


RULES: dict[str, Callable[[Builder, Ref], Ref]] = {
    "unary": lambda b, t: b.op("y", "gelu.default", (B, 3, 8), t),
    "scalar": lambda b, t: b.op("y", "mul.Tensor", (B, 3, 8), t, 2.0),
    "position": lambda b, t: b.op("y", "add.Tensor", (B, 3, 8), t, b.constant("p", 1, 3, 8)),
    "position on the left": lambda b, t: b.op("y", "sub.Tensor", (B, 3, 8), b.constant("p", 3, 8), t),
    "channel bias": lambda b, t: b.op("y", "add.Tensor", (B, 3, 8), t, b.constant("c", 8)),
    "with itself": lambda b, t: b.op("y", "mul.Tensor", (B, 3, 8), t, t),
    "linear": lambda b, t: b.op("y", "linear.default", (B, 3, 4), t, b.constant("w", 4, 8)),
    "matmul": lambda b, t: b.op("y", "matmul.default", (B, 3, 4), t, b.constant("w", 8, 4)),
    "layer_norm": lambda b, t: b.op("y", "layer_norm.default", (B, 3, 8), t, (8,)),
    "transpose": lambda b, t: b.op("y", "transpose.int", (3, B, 8), t, 0, -2),
    "permute": lambda b, t: b.op("y", "permute.default", (8, 3, B), t, (2, 1, 0)),
    "unsqueeze": lambda b, t: b.op("y", "unsqueeze.default", (B, 1, 3, 8), t, 1),
    "heads": lambda b, t: b.op("y", "reshape.default", (B, 3, 2, 4), t, (B, 3, 2, 4)),
    "select a channel": lambda b, t: b.op("y", "select.int", (B, 3), t, 2, 5),
    "slice channels": lambda b, t: b.op("y", "slice.Tensor", (B, 3, 4), t, 2, 0, 4),
    "softmax over channels": lambda b, t: b.op("y", "softmax.int", (B, 3, 8), t, -1),
}  # fmt: skip


@pytest.mark.parametrize("rule", RULES)
def test_token_wise_work_moves_above_the_concatenation(rule: str) -> None:
    b, joined = tokens()
    graph = b.graph(RULES[rule](b, joined))
    result, splitter = split(graph)
    assert last(result) == "aten.cat.default"
    assert splitter.bindings["y.part0"] is Binding.TABLE
    assert splitter.bindings["y.part1"] is Binding.CONDITION
    assert_same(graph, result)


def test_tokens_of_another_dtype_stay_together() -> None:
    b = Builder()
    time, obs = b.input("time", B, 1, 8), b.input("obs", B, 2, 8, dtype="int64")
    joined = b.op("tokens", "cat.default", (B, 3, 8), (time, obs), 1)
    result, splitter = split(b.graph(b.op("y", "linear.default", (B, 3, 4), joined, b.constant("w", 4, 8))))
    assert not splitter.split_at and len(result.nodes) == 2


NEAR_MISSES: dict[str, Callable[[Builder, Ref], Ref]] = {
    "softmax over tokens": lambda b, t: b.op("y", "softmax.int", (B, 3, 8), t, 1),
    "norm over tokens": lambda b, t: b.op("y", "layer_norm.default", (B, 3, 8), t, (3, 8)),
    "linear over tokens": lambda b, t: b.op(
        "y", "linear.default", (B, 8, 4), b.op("tt", "transpose.int", (B, 8, 3), t, 1, 2), b.constant("w", 4, 3)
    ),
    "tokens and channels flattened": lambda b, t: b.op("y", "reshape.default", (B, 24), t, (B, 24)),
    "one token selected": lambda b, t: b.op("y", "select.int", (B, 8), t, 1, 0),
    "tokens averaged": lambda b, t: b.op("y", "mean.dim", (B, 8), t, (1,)),
    "product of tokens with tokens": lambda b, t: b.op(
        "y", "matmul.default", (B, 3, 3), t, b.op("tt", "transpose.int", (B, 8, 3), t, 1, 2)
    ),
}


@pytest.mark.parametrize("case", NEAR_MISSES)
def test_what_mixes_tokens_is_not_split(case: str) -> None:
    b, joined = tokens()
    graph = b.graph(NEAR_MISSES[case](b, joined))
    result, splitter = split(graph)
    assert last(result) == graph.producers()["y"].op
    assert any("declined to split further at %" in note for note in splitter.notes)
    assert_same(graph, result)


def test_tokens_of_one_binding_time_are_left_alone() -> None:
    b = Builder()
    obs, more = b.input("obs", B, 2, 8), b.input("more", B, 1, 8)
    joined = b.op("tokens", "cat.default", (B, 3, 8), (obs, more), 1)
    graph = b.graph(b.op("y", "gelu.default", (B, 3, 8), joined))
    splitter = _Splitter(graph, {"obs": Binding.CONDITION, "more": Binding.CONDITION})
    assert splitter.run() == graph
    assert splitter.split_at == []


def test_neighbours_of_one_binding_time_stay_together() -> None:
    b = Builder()
    time, obs, more = b.input("time", B, 1, 8), b.input("obs", B, 2, 8), b.input("more", B, 3, 8)
    joined = b.op("tokens", "cat.default", (B, 6, 8), (obs, more, time), 1)
    graph = b.graph(b.op("y", "gelu.default", (B, 6, 8), joined))
    splitter = _Splitter(graph, {**INPUTS, "more": Binding.CONDITION})
    result = splitter.run()
    assert splitter.parts["tokens"].sizes == (5, 1)
    assert_same(graph, result)


def test_a_chunk_of_keys_and_values_is_split_with_its_items() -> None:
    from ttscompile.ir.graph import GETITEM, Node, TensorType

    b, joined = tokens()
    half = TensorType((B, 3, 4), "float32")
    b.nodes.append(Node("kv", "aten.split.Tensor", (joined, 4, 2), (), (half, half)))
    b.nodes.append(Node("k", GETITEM, (Ref("kv"), 1), (), (half,)))
    graph = b.graph(Ref("k"))
    result, _ = split(graph)
    assert last(result) == "aten.cat.default"
    assert_same(graph, result)
