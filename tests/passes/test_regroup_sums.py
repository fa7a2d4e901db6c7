"""Regrouping of sums: what is added to the stream becomes one value; nothing else is touched."""

import torch

from tests.passes.graphs import B, Builder
from tests.passes.specs import toy_spec
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Graph, Ref
from ttscompile.ir.program import Captured
from ttscompile.passes.find_residual_blocks import find_residual_blocks
from ttscompile.passes.regroup_sums import RegroupSums

SHAPE = (B, 4, 8)


def regrouped(graph: Graph) -> tuple[Graph, bool]:
    weights = {n: torch.randn(t.at(1)).numpy() for n, t in graph.constants.items()}
    captured = Captured(toy_spec(sample=(4, 8)), graph, weights)
    result = RegroupSums()(captured)
    value = {"sample": torch.randn(2, 4, 8)}
    tensors = {n: torch.from_numpy(w) for n, w in weights.items()}
    with Counted() as counted:
        before = evaluate(graph, tensors, value)[0]
    assert_equal_but_for_rounding(evaluate(result.program.denoiser, tensors, value)[0], before, counted.terms)
    return result.program.denoiser, result.program is not captured


def branches(builder: Builder, count: int) -> tuple[Ref, list[Ref]]:
    x = builder.input("sample", *SHAPE)
    return x, [builder.op(f"f{i}", "linear.default", SHAPE, x, builder.constant(f"w{i}", 8, 8)) for i in range(count)]


def test_parallel_branches_become_one_residual() -> None:
    b = Builder()
    x, (f, g, h) = branches(b, 3)
    total = b.op("s", "add.Tensor", SHAPE, x, f)
    total = b.op("y", "add.Tensor", SHAPE, b.op("t", "add.Tensor", SHAPE, g, total), h)
    graph, modified = regrouped(b.graph(total))
    table = find_residual_blocks(graph, "sample")
    (block,) = table.blocks
    assert modified and block.stream == "sample" and block.residual == "y.branches1"
    assert not any(said.startswith(("%s ", "%t ")) for said in table.declined)  # they are gone


def test_two_blocks_in_a_row_stay_two() -> None:
    b = Builder()
    h = b.residual("a1", b.residual("a0", b.input("sample", *SHAPE)))
    _, modified = regrouped(b.graph(h))
    assert not modified


def test_a_sum_that_something_else_reads_stays() -> None:
    b = Builder()
    x, (f, g) = branches(b, 2)
    part = b.op("s", "add.Tensor", SHAPE, x, f)
    total = b.op("y", "add.Tensor", SHAPE, part, g)
    _, modified = regrouped(b.graph(b.op("z", "mul.Tensor", SHAPE, total, part)))
    assert not modified


def test_a_position_is_no_branch() -> None:
    b = Builder()
    x, (f,) = branches(b, 1)
    placed = b.op("s", "add.Tensor", SHAPE, b.constant("position", 1, 4, 8), f)
    _, modified = regrouped(b.graph(b.op("y", "add.Tensor", SHAPE, placed, x)))
    assert not modified
