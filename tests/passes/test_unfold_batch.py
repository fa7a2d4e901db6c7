"""What crosses between pieces has an axis of streams, also where a stream has several rows."""

from collections.abc import Callable

import pytest
import torch

from tests.passes.graphs import B, Builder
from tests.passes.modules import HALVES, TWICE, Doubled
from tests.passes.specs import toy_spec
from ttscompile.driver import transform
from ttscompile.errors import PassError
from ttscompile.ir.graph import Batch
from ttscompile.ir.rows import unfold


@pytest.mark.slow
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
    for piece in (*program.pieces.blocks, program.pieces.tail):
        assert all(type_.batch_axis is not None for type_ in piece.graph.inputs.values())


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
