"""What adds in other words becomes an addition where the residual stream is; nothing else is touched."""

from typing import Any

import pytest
import torch

from tests.passes.graphs import B, Builder
from tests.passes.specs import toy_spec
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Graph, Ref
from ttscompile.ir.program import Captured
from ttscompile.passes.clean_up import CleanUp
from ttscompile.passes.find_residual_blocks import find_residual_blocks
from ttscompile.passes.write_sums import WriteSums

SHAPE = (B, 4, 8)


def written(graph: Graph) -> tuple[Graph, bool]:
    """What the pass makes of it, computed beside it; and whether that is another graph."""
    weights = {n: torch.randn(t.at(1)).numpy() for n, t in graph.constants.items()}
    captured = Captured(toy_spec(sample=(4, 8)), graph, weights)
    result = WriteSums()(captured).program
    assert WriteSums()(result).program is result
    value, tensors = {"sample": torch.randn(2, 4, 8)}, {n: torch.from_numpy(w) for n, w in weights.items()}
    with Counted() as counted:
        before = evaluate(graph, tensors, value)[0]
    assert_equal_but_for_rounding(evaluate(result.denoiser, tensors, value)[0], before, counted.terms)
    return result.denoiser, result is not captured


WAYS: dict[str, tuple[str, list[Any], dict[str, Any]]] = {
    "addcmul": ("addcmul.default", ["gate", "f"], {}),
    "addcmul, the branch first": ("addcmul.default", ["f", "gate"], {"value": 0.5}),
    "with a factor": ("add.Tensor", ["f"], {"alpha": 0.5}),
    "subtracted": ("sub.Tensor", ["f"], {}),
    "subtracted, with a factor": ("sub.Tensor", ["f"], {"alpha": 3}),
}


@pytest.mark.parametrize("way", WAYS)
def test_two_blocks_are_found(way: str) -> None:
    op, names, options = WAYS[way]
    b = Builder()
    x = b.input("sample", *SHAPE)
    for i in range(2):
        f = b.op(f"f{i}", "linear.default", SHAPE, x, b.constant(f"w{i}", 8, 8))
        operands = {"gate": b.constant(f"g{i}", 8), "f": f}
        x = b.op(f"y{i}", op, SHAPE, x, *(operands[name] for name in names), **options)
    found, changed = written(b.graph(x))
    assert changed and len(find_residual_blocks(found, "sample").blocks) == 2


def test_only_the_stream_is_written_anew() -> None:
    """Not a difference inside a block, nor one of a mean that is broadcast, nor one of a constant."""
    b = Builder()
    x = b.input("sample", *SHAPE)
    centred = b.op("c", "sub.Tensor", SHAPE, x, b.op("m", "mean.dim", (B, 4, 1), x, (2,), True))
    turned = b.op("t", "sub.Tensor", SHAPE, centred, b.op("f", "linear.default", SHAPE, x, b.constant("w", 8, 8)))
    total = b.op("y", "add.Tensor", SHAPE, x, turned)
    placed = b.op("p", "sub.Tensor", SHAPE, total, b.constant("position", 4, 8))
    assert not written(b.graph(placed))[1]


def test_a_sum_of_python_begins_with_zero() -> None:
    b = Builder()
    x = b.input("sample", *SHAPE)
    f = b.op("f", "linear.default", SHAPE, x, b.constant("w", 8, 8))
    graph = b.graph(b.op("y", "add.Tensor", SHAPE, b.op("z", "add.Tensor", SHAPE, x, 0), f))
    captured = Captured(toy_spec(sample=(4, 8)), graph, {"w": torch.randn(8, 8).numpy()})
    cleaned = CleanUp[Captured]()(captured).program.denoiser
    assert [node.name for node in cleaned.nodes] == ["f", "y"]
    assert cleaned.producers()["y"].args == (Ref("sample"), Ref("f"))
