"""Golden texts of what the passes make, and proof that the comparator can say no."""

import pytest

from tests.ir.golden_text import assert_text
from tests.passes.graphs import B, Builder, chain
from ttscompile.ir.graph import Graph, backward_slice
from ttscompile.ir.program import Binding
from ttscompile.passes.clean_up import drop_dead, drop_identities, merge_repeated
from ttscompile.passes.split_tokens import _Splitter

CHAIN = """
inputs    %x : float32[B, 4, 2]
constants %w_in : float32[8, 2], %w : float32[8, 8], %w_out : float32[2, 8]
  %h : float32[B, 4, 8] = aten.linear.default(%x, %w_in)
  %f : float32[B, 4, 8] = aten.linear.default(%h, %w)
  %a : float32[B, 4, 8] = aten.add.Tensor(%h, %f)
  %y : float32[B, 4, 2] = aten.linear.default(%a, %w_out)
outputs   %y
"""


def test_a_chain_reads_like_this() -> None:
    assert_text(chain(1), CHAIN)


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("aten.add.Tensor(%h, %f)", "aten.add.Tensor(%f, %h)"),  # other wiring
        ("aten.add.Tensor", "aten.sub.Tensor"),  # other operation
        ("%a : float32[B, 4, 8]", "%a : float32[2*B, 4, 8]"),  # other shape
        ("%w_in : float32[8, 2]", "%w_in : float64[8, 2]"),  # other dtype
        ("outputs   %y", "outputs   %a"),  # other output
        ("  %f : float32[B, 4, 8] = aten.linear.default(%h, %w)\n", ""),  # a line less
    ],
)
def test_the_comparator_says_no(right: str, wrong: str) -> None:
    assert right in CHAIN
    with pytest.raises(AssertionError, match="differs from its golden text"):
        assert_text(chain(1), CHAIN.replace(right, wrong))


def test_a_slice_takes_the_stream_as_its_input() -> None:
    graph = chain(2)
    piece = backward_slice(graph, ("a1.f",), {"a0": graph.types()["a0"]})
    assert_text(
        piece,
        """
        inputs    %a0 : float32[B, 4, 8]
        constants %w : float32[8, 8]
          %f : float32[B, 4, 8] = aten.linear.default(%a0, %w)
        outputs   %f
        """,
    )


def _keys() -> Graph:
    b = Builder()
    joined = b.op("cat", "cat.default", (B, 3, 8), (b.input("time", B, 1, 8), b.input("obs", B, 2, 8)), 1)
    biased = b.op("biased", "add.Tensor", (B, 3, 8), joined, b.constant("position", 3, 8))
    return b.graph(b.op("k", "linear.default", (B, 3, 4), biased, b.constant("w", 4, 8)))


def test_split_tokens_reads_like_this() -> None:
    splitter = _Splitter(_keys(), {"time": Binding.TABLE, "obs": Binding.CONDITION})
    assert_text(
        drop_dead(splitter.run()),
        """
        inputs    %time : float32[B, 1, 8], %obs : float32[B, 2, 8]
        constants %position : float32[3, 8], %w : float32[4, 8]
          %p0 : float32[1, 8] = aten.slice.Tensor(%position, 0, 0, 1)
          %b0 : float32[B, 1, 8] = aten.add.Tensor(%time, %p0)
          %p1 : float32[2, 8] = aten.slice.Tensor(%position, 0, 1, 3)
          %b1 : float32[B, 2, 8] = aten.add.Tensor(%obs, %p1)
          %k0 : float32[B, 1, 4] = aten.linear.default(%b0, %w)
          %k1 : float32[B, 2, 4] = aten.linear.default(%b1, %w)
          %k : float32[B, 3, 4] = aten.cat.default([%k0, %k1], 1)
        outputs   %k
        """,
    )


def test_clean_up_reads_like_this() -> None:
    b = Builder()
    x = b.input("x", B, 4, 8)
    same = b.op("same", "clone.default", (B, 4, 8), x)
    off = b.op("off", "detach.default", (B, 4, 8), same)
    one, two = b.op("one", "sin.default", (B, 4, 8), off), b.op("two", "sin.default", (B, 4, 8), x)
    b.op("dead", "cos.default", (B, 4, 8), one)
    graph = b.graph(b.op("y", "mul.Tensor", (B, 4, 8), one, two))
    assert_text(
        drop_dead(merge_repeated(drop_identities(graph))),
        """
        inputs    %x : float32[B, 4, 8]
        constants
          %s : float32[B, 4, 8] = aten.sin.default(%x)
          %y : float32[B, 4, 8] = aten.mul.Tensor(%s, %s)
        outputs   %y
        """,
    )


def test_clean_up_keeps_what_only_looks_like_nothing() -> None:
    b = Builder()
    x = b.input("x", B, 4, 8)
    on = b.op("on", "flip.default", (B, 4, 8), x, (1,))  # of the same type, in another order
    reshaped = b.op("reshaped", "reshape.default", (B, 32), on, (B, 32))
    ones = b.op("ones", "mul.Tensor", (B, 32), reshaped, 1)
    floats = b.op("floats", "mul.Tensor", (B, 32), reshaped, 1.0)  # 1 == 1.0 in Python, not in a graph
    graph = b.graph(b.op("y", "sub.Tensor", (B, 32), ones, floats))
    assert drop_dead(merge_repeated(drop_identities(graph))) == graph


def test_outputs_keep_their_names() -> None:
    b = Builder()
    x = b.input("x", B, 4, 8)
    graph = b.graph(b.op("y", "clone.default", (B, 4, 8), x), b.op("z", "clone.default", (B, 4, 8), x))
    assert merge_repeated(drop_identities(graph)).outputs == ("y", "z")
    assert len(drop_dead(merge_repeated(drop_identities(graph))).nodes) == 2
