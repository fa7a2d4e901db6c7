"""Doubled batches: copies are cut by their number, and what crosses between pieces has an axis of streams."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import nn

from tests.passes.graphs import B, Builder
from tests.passes.specs import toy_spec
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.capture.batch import unify_batch
from ttscompile.capture.export import capture
from ttscompile.driver import transform
from ttscompile.errors import CaptureError, PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Batch, Graph, Node, Ref, TensorType
from ttscompile.ir.program import Program
from ttscompile.ir.rows import unfold
from ttscompile.passes.cut_copies import CutCopies
from ttscompile.passes.widen_attention import WidenAttention

TWICE = (Batch(2), 4, 2)


class Doubled(nn.Module):
    """A residual on a batch that ``double`` makes of the sample, and ``halve`` makes one of again."""

    def __init__(self, double: Callable[[torch.Tensor], torch.Tensor], halve: Callable[..., torch.Tensor]) -> None:
        super().__init__()
        self.ff, self.double, self.halve = nn.Linear(2, 2), double, halve

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        x = self.double(sample) * self.double(obs)[:, None, :2]
        x = x + torch.tanh(self.ff(x)) * self.double(timestep)[:, None, None]
        return self.halve(x + self.ff(x))


HALVES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "slices": lambda x: x[: len(x) // 2] - 0.3 * x[len(x) // 2 :],
    "split": lambda x: torch.sub(*torch.split(x, len(x) // 2)),
    "chunk": lambda x: torch.sub(*x.chunk(2)),
}


@pytest.mark.parametrize("halve", HALVES)
def test_copies_are_cut_by_their_number(halve: str) -> None:
    module = Doubled(lambda x: torch.cat([x, x]), HALVES[halve]).eval()
    graph, weights = capture(module, toy_spec())
    result = CutCopies()(Program(toy_spec(), graph, weights))
    cut = result.program.denoiser
    assert result.modified
    assert not any(
        isinstance(a, Batch) for n in cut.nodes if n.op.startswith(("aten.slice", "aten.split")) for a in n.args
    )
    inputs = {"sample": torch.randn(3, 4, 2), "timestep": torch.arange(3), "obs": torch.randn(3, 3)}
    with torch.no_grad(), Counted() as counted:
        expected = module(*inputs.values())
    found = evaluate(cut, {n: torch.from_numpy(w) for n, w in weights.items()}, inputs)[0]
    assert_equal_but_for_rounding(found, expected, counted.terms)


@pytest.mark.parametrize(
    ("double", "shape"),
    [
        (lambda x: torch.cat([x, x]), (2, B, 4, 2)),
        (lambda x: x.repeat(2, *(1,) * (x.dim() - 1)), (2, B, 4, 2)),
        (lambda x: torch.stack([x, x], 1).flatten(0, 1), (B, 2, 4, 2)),
        (lambda x: torch.stack([x, x], 0).flatten(0, 1), (2, B, 4, 2)),
    ],
)
def test_the_stream_of_a_doubled_batch_has_an_axis_of_streams(
    double: Callable[[torch.Tensor], torch.Tensor], shape: tuple[object, ...]
) -> None:
    halve = HALVES["chunk"] if shape[0] == 2 else lambda x: x.unflatten(0, (-1, 2)).sum(1)
    program = transform(Doubled(double, halve).eval(), toy_spec())
    assert {block.type.shape for block in program.blocks} == {shape}
    assert len(program.blocks) == 2
    assert program.pieces is not None
    for piece in (*program.pieces.blocks, program.pieces.tail):
        assert all(type_.batch_axis is not None for type_ in piece.inputs.values())


def test_boundaries_may_be_counted_from_the_end() -> None:
    b = Builder()
    x = b.input("sample", B, 4, 2)
    both = b.op("both", "cat.default", TWICE, (x, x), 0)
    given = b.op("given", "slice.Tensor", (B, 4, 2), both, 0, 0, Batch(-1))
    free = b.op("free", "slice.Tensor", (B, 4, 2), both, 0, Batch(-1), 2**63 - 1)
    cut = CutCopies()(Program(toy_spec(), b.graph(given, free), {})).program.denoiser
    assert [n.args[2] for n in cut.nodes if n.op == "aten.select.int"] == [0, 1]
    assert unify_batch(graph(10, -5), graph(14, -7)).nodes[0].args[3] == Batch(-1)


def test_rows_of_unknown_order_are_refused() -> None:
    b = Builder()
    both = b.op("both", "index_select.default", TWICE, b.input("x", B, 4, 2), 0, b.constant("order", 6))
    with pytest.raises(PassError, match=r"%both : float32\[2\*B, 4, 2\] has several rows a stream"):
        unfold(b.graph(both), ["both"])


def test_heads_in_a_doubled_batch_lie_behind_the_streams() -> None:
    b = Builder()
    x = b.input("x", B, 4, 8)
    both = b.op("both", "cat.default", (Batch(2), 4, 8), (x, x), 0)
    heads = b.op("heads", "reshape.default", (Batch(2), 4, 2, 4), both, (Batch(2), 4, 2, 4))
    turned = b.op("turned", "transpose.int", (Batch(2), 2, 4, 4), heads, 1, 2)
    folded = b.op("folded", "reshape.default", (Batch(4), 4, 4), turned, (Batch(4), 4, 4))
    back = b.op("back", "reshape.default", (Batch(2), 2, 16), folded, (Batch(2), 2, 16))
    more = b.op("more", "cat.default", (Batch(6), 4, 4), (folded, b.op("one", "exp.default", (Batch(2), 4, 4), x)), 0)
    found = unfold(b.graph(back, more), ["both", "folded", "back"])
    assert {name: rows.unfolded.shape for name, rows in found.items()} == {
        "both": (2, B, 4, 8),
        "folded": (2, B, 2, 4, 4),
        "back": (2, B, 2, 16),
    }
    with pytest.raises(PassError, match="%more .* cannot be seen"):
        unfold(b.graph(more), ["more"])


def test_rows_that_are_all_alike_fit_any_layout() -> None:
    b = Builder()
    keys = b.op("keys", "repeat_interleave.self_int", TWICE, b.input("x", B, 4, 2), 2, 0)
    none = b.op("none", "zeros.default", (Batch(2), 1, 2), (Batch(2), 1, 2))
    row = b.op("row", "expand.default", TWICE, b.constant("bias", 1, 4, 2), TWICE)
    more = b.op("more", "cat.default", (Batch(2), 5, 2), (b.op("sum", "add.Tensor", TWICE, keys, row), none), 1)
    found = unfold(b.graph(more), ["more", "row", "none"])
    assert [rows.unfolded.shape for rows in found.values()] == [(B, 2, 5, 2), (2, B, 4, 2), (2, B, 1, 2)]


@pytest.mark.parametrize(
    ("op", "axes", "found"), [("roll", ((1,), (1,)), True), ("flip", ((0,),), False), ("roll", ((1,), (0,)), False)]
)
def test_rows_that_change_places_are_refused(op: str, axes: tuple[object, ...], found: bool) -> None:
    b = Builder()
    x = b.input("x", B, 4, 2)
    both = b.op("both", "cat.default", TWICE, (x, x), 0)
    moved = b.op("moved", f"{op}.default", TWICE, both, *axes)  # type: ignore[arg-type]
    if found:
        assert unfold(b.graph(moved), ["moved"])["moved"].unfolded.shape == (2, B, 4, 2)
    else:
        with pytest.raises(PassError, match="several rows a stream"):
            unfold(b.graph(moved), ["moved"])


def test_values_with_an_axis_of_streams_are_left_alone() -> None:
    b = Builder()
    assert unfold(b.graph(b.op("y", "neg.default", (2, B), b.input("x", 2, B))), ["x", "y"]) == {}


def graph(size: int, argument: object = 1) -> Graph:
    node = Node("y", "aten.slice.Tensor", (Ref("x"), 0, 0, argument), (), (TensorType((size,), "float32"),), "a.py:1")  # type: ignore[arg-type]
    return Graph({"x": TensorType((size,), "float32")}, {}, (node,), ("y",))


def test_sizes_that_grow_with_the_batch_are_multiples_of_it() -> None:
    found = unify_batch(graph(10, 5), graph(14, 7))
    assert found.inputs["x"].shape == (Batch(2),) and found.nodes[0].args[3] == Batch()


def test_what_depends_on_the_batch_otherwise_is_refused() -> None:
    with pytest.raises(CaptureError, match=r"%y \(a.py:1\) is 6 for a batch of 5 and 8 for 7"):
        unify_batch(graph(5, 6), graph(7, 8))
    with pytest.raises(CaptureError, match="has the argument True or False"):
        unify_batch(graph(5, True), graph(7, False))


class Branches(nn.Module):
    """Does something else for many streams."""

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        y = sample.chunk(len(sample), 0)[0] if len(sample) > 5 else sample
        return y.expand(sample.shape) * obs[:, :1, None]


def test_a_module_that_looks_at_the_number_of_streams_is_refused() -> None:
    with pytest.raises(CaptureError):
        capture(Branches(), toy_spec())


@pytest.mark.parametrize("mask", [None, (4, 4), (B, 4, 4)])
def test_attention_without_heads_gets_one(mask: tuple[object, ...] | None) -> None:
    b = Builder()
    x = b.input("sample", B, 4, 2)
    seen = None if mask is None else b.input("mask", *mask)  # type: ignore[arg-type]
    y = b.op("y", "scaled_dot_product_attention.default", (B, 4, 2), x, x, x, seen)
    result = WidenAttention()(Program(toy_spec(), b.graph(y), {}))
    wide = result.program.denoiser
    (attention,) = [n for n in wide.nodes if n.op.startswith("aten.scaled_dot")]
    assert attention.type.shape == (B, 1, 4, 2) and result.modified
    values = {"sample": torch.randn(3, 4, 2)}
    if mask is not None:
        values["mask"] = torch.randn(4, 4) if len(mask) == 2 else torch.randn(3, 4, 4)
    with Counted() as counted:
        (expected,) = evaluate(b.graph(y), {}, values)
    assert_equal_but_for_rounding(evaluate(wide, {}, values)[0], expected, counted.terms)


@pytest.mark.parametrize("shape", [(B, 1, 1, 5), (3, 4, 5), (1, 5)])
def test_masks_get_a_row_for_each_query(shape: tuple[object, ...]) -> None:
    b = Builder()
    x, memory = b.input("sample", B, 3, 4, 2), b.input("memory", B, 3, 5, 2)
    mask = b.input("mask", *shape)  # type: ignore[arg-type]
    z = b.op("y", "scaled_dot_product_attention.default", (B, 3, 4, 2), x, memory, memory, mask)
    y = b.op("z", "scaled_dot_product_attention.default", (B, 3, 4, 2), z, memory, memory, mask)
    result = WidenAttention()(Program(toy_spec(), b.graph(y), {}))
    wide = result.program.denoiser
    assert [n.type.shape[-2:] for n in wide.nodes if n.op == "aten.expand.default"] == [(4, 5)]  # one for both
    assert len(wide.types()["y.mask"].shape) == 4
    values = {name: torch.randn(type_.at(2)) for name, type_ in wide.inputs.items()}
    with Counted() as counted:
        (expected,) = evaluate(b.graph(y), {}, values)
    assert_equal_but_for_rounding(evaluate(wide, {}, values)[0], expected, counted.terms)
    assert not WidenAttention()(result.program).modified


def test_attention_with_heads_is_left_alone() -> None:
    b = Builder()
    x = b.input("sample", B, 2, 4, 2)
    y = b.op("y", "scaled_dot_product_attention.default", (B, 2, 4, 2), x, x, x)
    assert not WidenAttention()(Program(toy_spec(), b.graph(y), {})).modified
