"""Graphs as functions of torch: what is written is what the graph says, in fewer operations."""

import dis
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.rounding import assert_equal_but_for_rounding
from ttscompile.artifact import Artifact
from ttscompile.errors import CaptureError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Enum, Graph, Ref
from ttscompile.runtimes.torch.functions import write_function

from .toys import B, f32, node


def attention() -> Graph:
    """Products, moves of all sorts that change how memory is seen, and constants that can be computed ahead."""
    x, wide, heads = f32(B, 3, 4), f32(B, 3, 8), f32(B, 2, 3, 4)
    nodes = (
        node("t", "transpose.int", f32(4, 8), Ref("w"), 0, 1),
        node("tt", "transpose.int", f32(8, 4), Ref("t"), 0, 1),
        node("y", "linear.default", wide, Ref("x"), Ref("tt"), Ref("b")),
        node("g", "gelu.default", wide, Ref("y")),
        node("v", "reshape.default", f32(B, 3, 2, 4), Ref("g"), (B, 3, 2, 4)),
        node("h", "transpose.int", heads, Ref("v"), 1, 2),
        node("s", "select.int", f32(B, 3, 4), Ref("h"), 1, 1),
        node("u", "unsqueeze.default", f32(B, 1, 3, 4), Ref("s"), 1),
        node("a", "add.Tensor", heads, Ref("h"), Ref("u")),
        node("p", "permute.default", f32(3, B, 4, 2), Ref("a"), (2, 0, 3, 1)),
        node("c", "reshape.default", f32(3, B, 8), Ref("p"), (3, B, 8)),
        node("z", "sum.dim_IntList", f32(3, B), Ref("c"), (2,)),
    )
    return Graph({"x": x}, {"w": f32(8, 4), "b": f32(8)}, nodes, ("z", "h", "x"))


def test_a_function_computes_what_its_graph_says_and_nothing_of_constants_alone() -> None:
    graph, rng = attention(), torch.Generator().manual_seed(0)
    weights = {name: torch.randn(kind.at(1), generator=rng) for name, kind in graph.constants.items()}
    for streams in (1, 3):
        function = write_function(graph, weights, [torch.zeros(streams, 3, 4)], streams, None)
        for _ in range(2):
            x = torch.randn(streams, 3, 4, generator=rng)
            found, expected = function(x), evaluate(graph, weights, {"x": x})
            assert found[2] is x
            for one, other in zip(found, expected, strict=True):
                assert_equal_but_for_rounding(one, other, 40)
        names = function.__code__.co_varnames
        assert len(names) - 1 < len(graph.nodes), names  # what is made of the weight alone is made once


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"op": "aten.from_file.default"}, "not a pure function|reads files|does not exist"),
        ({"args": (Ref("x"), Enum("dtype", "Tensor"))}, "no such dtype"),
    ],
)
def test_a_graph_that_cannot_be_written_is_refused(change: dict[str, Any], message: str) -> None:
    one = replace(node("y", "tanh.default", f32(B, 4), Ref("x")), **change)
    with pytest.raises(CaptureError, match=message):
        write_function(Graph({"x": f32(B, 4)}, {}, (one,), ("y",)), {}, [torch.zeros(1, 4)], 1, None)


def test_nothing_of_an_artifact_gets_into_the_source_of_a_function() -> None:
    """Names of arguments are the only text of a graph that a function holds, and operations take none but their own."""
    wrong = "alpha=print('executed'), beta"
    bad = replace(node("y", "add.Tensor", f32(B, 4), Ref("x"), Ref("x")), kwargs=((wrong, 1),))
    with pytest.raises((TypeError, RuntimeError), match="print"):
        write_function(Graph({"x": f32(B, 4)}, {}, (bad,), ("y",)), {}, [torch.zeros(1, 4)], 1, None)
    odd = replace(node("y'; print()", "tanh.default", f32(B, 4), Ref("x); print(")), kwargs=())
    graph = Graph({"x); print(": f32(B, 4)}, {}, (odd,), ("y'; print()",))
    x = torch.ones(1, 4)
    assert torch.equal(write_function(graph, {}, [x], 1, None)(x)[0], x.tanh())


def test_weights_of_products_are_kept_in_fewer_bits(toy_artifact: Artifact) -> None:
    graph = toy_artifact.pieces.blocks[0].graph
    weights = {name: torch.from_numpy(np.array(value)) for name, value in toy_artifact.weights.items()}
    examples = [torch.randn(kind.at(1)) for kind in graph.inputs.values()]
    with torch.autocast("cpu", torch.bfloat16):
        function = write_function(graph, weights, examples, 1, torch.bfloat16)
    kept = [each for each in function.__globals__.values() if isinstance(each, torch.Tensor)]
    assert {each.dtype for each in kept} == {torch.bfloat16}


def rms_graph(axis: int = -1, power: int = 2) -> Graph:
    kind, one = f32(B, 3, 4), f32(B, 3, 1)
    nodes = (
        node("square", "pow.Tensor_Scalar", kind, Ref("x"), power),
        node("mean", "mean.dim", one, Ref("square"), (axis,), True),
        node("added", "add.Tensor", one, Ref("mean"), 1e-5),
        node("root", "rsqrt.default", one, Ref("added")),
        node("scaled", "mul.Tensor", kind, Ref("x"), Ref("root")),
        node("normed", "mul.Tensor", kind, Ref("scaled"), Ref("w")),
        node("q", "linear.default", kind, Ref("normed"), Ref("wide")),
        node("k", "linear.default", kind, Ref("normed"), Ref("wide")),
    )
    return Graph({"x": kind}, {"w": f32(4), "wide": f32(4, 4)}, nodes, ("q", "k", "normed"))


def drawn(graph: Graph) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Weights of a graph, and what it is given: two streams ``[2, 3, 4]``."""
    draw = torch.Generator().manual_seed(0)
    weights = {name: torch.randn(kind.at(1), generator=draw) for name, kind in graph.constants.items()}
    return weights, torch.randn(2, 3, 4, generator=draw)


@pytest.mark.parametrize(("axis", "power", "fused"), [(-1, 2, True), (-1, 4, False), (-2, 2, False)])
def test_an_rms_norm_is_one_operation(axis: int, power: int, fused: bool) -> None:
    """And nothing else is, which only looks like it; of axis -2 the mean is of another shape, which broadcasts too."""
    graph = rms_graph(axis, power)
    weights, x = drawn(graph)
    function = write_function(graph, weights, [x], 2, None)
    calls = function.__code__.co_names
    assert (torch.rms_norm in [function.__globals__[name] for name in calls]) == fused
    for found, expected in zip(function(x), evaluate(graph, weights, {"x": x}), strict=True):
        assert_equal_but_for_rounding(found, expected, 64)


def test_what_several_products_read_is_narrowed_once() -> None:
    graph = rms_graph()
    weights, x = drawn(graph)
    with torch.autocast("cpu", torch.bfloat16):
        function = write_function(graph, weights, [x], 2, torch.bfloat16)
        found, expected = function(x), evaluate(graph, weights, {"x": x})
    assert [each.dtype for each in found] == [torch.bfloat16, torch.bfloat16, torch.float32]
    assert [each.argval for each in dis.get_instructions(function)].count("narrow") == 1
    for one, other in zip(found, expected, strict=True):
        assert_equal_but_for_rounding(one.float(), other.float(), 64, unit=2.0**-8)


def test_an_rms_norm_of_a_product_stays_in_fp32() -> None:
    """What a product gives is narrow, and torch would norm it in that type; so it is computed as it was captured."""
    graph = rms_graph()
    first = node("x", "linear.default", f32(B, 3, 4), Ref("given"), Ref("wide"))
    graph = replace(graph, inputs={"given": f32(B, 3, 4)}, nodes=(first, *graph.nodes), outputs=("normed",))
    weights, x = drawn(graph)
    with torch.autocast("cpu", torch.bfloat16):
        found = write_function(graph, weights, [x], 2, torch.bfloat16)(x)[0]
        expected = evaluate(graph, weights, {"given": x})[0]
    assert found.dtype == expected.dtype == torch.float32
    assert_equal_but_for_rounding(found, expected, 64)


def test_an_rms_norm_with_other_arguments_is_another_one() -> None:
    graph = rms_graph()
    added = next(one for one in graph.nodes if one.name == "added")
    nodes = tuple(replace(one, kwargs=(("alpha", 3),)) if one is added else one for one in graph.nodes)
    graph, x = replace(graph, nodes=nodes), 1e-3 * torch.randn(2, 3, 4, generator=torch.Generator().manual_seed(0))
    weights = {name: torch.ones(kind.at(1)) for name, kind in graph.constants.items()}
    found, expected = write_function(graph, weights, [x], 2, None)(x), evaluate(graph, weights, {"x": x})
    assert_equal_but_for_rounding(found[2], expected[2], 64)
