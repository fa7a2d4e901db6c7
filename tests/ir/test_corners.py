"""Cases of the IR that real networks have seldom."""

from dataclasses import replace

import pytest
import torch

from tests.passes.graphs import B, Builder, chain
from tests.passes.specs import toy_spec
from ttscompile.errors import PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.graph import TensorType
from ttscompile.ir.program import Captured
from ttscompile.ir.verify import verify, verify_graph
from ttscompile.lower.layout import sink_layout
from ttscompile.passes.find_residual_blocks import find_residual_blocks
from ttscompile.passes.partition import Partition


def test_an_output_that_is_given_twice() -> None:
    b = Builder()
    y = b.op("y", "transpose.int", (3, B), b.op("f", "exp.default", (B, 3), b.input("x", B, 3)), 0, 1)
    sunk = sink_layout(b.graph(y, y))
    verify_graph(sunk, "sunk")
    x = torch.randn(2, 3)
    torch.testing.assert_close(evaluate(sunk, {}, {"x": x}), (x.exp().T, x.exp().T))


def test_a_transposed_convolution_spreads_its_inputs() -> None:
    b = Builder()
    y = b.op("y", "conv_transpose1d.default", (B, 6, 21), b.input("x", B, 4, 10), b.constant("w", 4, 6, 3), None, (2,))
    assert graph_flops(b.graph(y)) == 2 * (4 * 10) * (6 * 3)


@pytest.mark.parametrize(
    ("equation", "flops"),
    [("btd,bsd->bts", 2 * 4 * 3 * 8), ("...td,...sd->...ts", 2 * 4 * 3 * 8), ("...d, sd", 2 * 4 * 3 * 8)],
)
def test_flops_of_an_einsum(equation: str, flops: int) -> None:
    b = Builder()
    keys = b.input("k", B, 3, 8) if "bsd" in equation or "...s" in equation else b.constant("k", 3, 8)
    y = b.op("y", "einsum.default", (B, 4, 3), equation, (b.input("x", B, 4, 8), keys))
    assert graph_flops(b.graph(y)) == flops


def test_flops_of_a_recurrent_layer() -> None:
    b = Builder()
    weights = (b.constant("in", 48, 7), b.constant("back", 48, 16), b.constant("bias", 48))
    arguments = (b.input("x", B, 5, 7), b.input("h", 1, B, 16), weights, True, 1, 0.0, False, False, True)
    assert graph_flops(b.graph(b.op("y", "gru.input", (B, 5, 16), *arguments))) == 2 * 5 * 48 * (7 + 16)


def test_a_context_that_nothing_gives_is_found_before_hoist() -> None:
    graph = replace(
        chain(1),
        inputs={"x": TensorType((B, 4, 2), "float32"), "timestep": TensorType((B,), "int64"),
                "obs": TensorType((B, 3), "float32")},
    )  # fmt: skip
    spec = replace(toy_spec(), sample_argument="x")
    weights = {name: torch.zeros(type_.at(1)).numpy() for name, type_ in graph.constants.items()}
    cut = Partition(find_residual_blocks(graph, "x").blocks)(Captured(spec, graph, weights)).program
    verify(cut)
    tail = cut.loop.tail
    reads = replace(tail.graph, inputs={**tail.graph.inputs, "obs": graph.inputs["obs"]})
    broken = replace(cut, loop=replace(cut.loop, tail=replace(tail, graph=reads)))
    with pytest.raises(PassError, match="tail: nothing provides its context %obs"):
        verify(broken)
