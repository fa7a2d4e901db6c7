"""Attention gets an axis of heads, and masks a row for each query."""

import pytest
import torch

from tests.passes.graphs import B, Builder
from tests.passes.specs import toy_spec
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.program import Captured
from ttscompile.passes.widen_attention import WidenAttention


@pytest.mark.parametrize("mask", [None, (4, 4), (B, 4, 4)])
def test_attention_without_heads_gets_one(mask: tuple[object, ...] | None) -> None:
    b = Builder()
    x = b.input("sample", B, 4, 2)
    seen = None if mask is None else b.input("mask", *mask)  # type: ignore[arg-type]
    y = b.op("y", "scaled_dot_product_attention.default", (B, 4, 2), x, x, x, seen)
    captured = Captured(toy_spec(), b.graph(y), {})
    result = WidenAttention()(captured)
    wide = result.program.denoiser
    (attention,) = [n for n in wide.nodes if n.op.startswith("aten.scaled_dot")]
    assert attention.type.shape == (B, 1, 4, 2) and result.program is not captured
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
    result = WidenAttention()(Captured(toy_spec(), b.graph(y), {}))
    wide = result.program.denoiser
    assert [n.type.shape[-2:] for n in wide.nodes if n.op == "aten.expand.default"] == [(4, 5)]  # one for both
    assert len(wide.types()["y.mask"].shape) == 4
    values = {name: torch.randn(type_.at(2)) for name, type_ in wide.inputs.items()}
    with Counted() as counted:
        (expected,) = evaluate(b.graph(y), {}, values)
    assert_equal_but_for_rounding(evaluate(wide, {}, values)[0], expected, counted.terms)
    assert WidenAttention()(result.program).program is result.program


def test_attention_with_heads_is_left_alone() -> None:
    b = Builder()
    x = b.input("sample", B, 2, 4, 2)
    y = b.op("y", "scaled_dot_product_attention.default", (B, 2, 4, 2), x, x, x)
    captured = Captured(toy_spec(), b.graph(y), {})
    assert WidenAttention()(captured).program is captured
