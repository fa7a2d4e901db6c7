"""The block finder on graphs that have blocks, almost have them, and have none."""

from collections.abc import Callable

import pytest
import torch
from torch import nn

from tests.passes.graphs import B, Builder, chain
from tests.passes.specs import toy_spec
from ttscompile.errors import NoResidualBlocksError, PassError
from ttscompile.ir.graph import GETITEM, Graph, Node, Ref, TensorType
from ttscompile.passes.find_residual_blocks import find_residual_blocks


def kinds(graph: Graph) -> list[str]:
    return [block.kind for block in find_residual_blocks(graph, "x").blocks]


def test_a_plain_chain_is_found_block_by_block() -> None:
    table = find_residual_blocks(chain(3), "x")
    assert [(b.stream, b.residual, b.result) for b in table.blocks] == [
        ("embed", "a0.f", "a0"), ("a0", "a1.f", "a1"), ("a1", "a2.f", "a2"),
    ]  # fmt: skip
    assert {b.kind for b in table.blocks} == {"feed_forward"}
    assert {b.group for b in table.blocks} == {0}
    assert table.declined == ()


def _beside(b: Builder, x: Ref) -> Ref:
    return b.op("g", "linear.default", (B, 4, 8), x, b.constant("v", 8, 8))


SUMMANDS: dict[str, Callable[[Builder, Ref, Ref], tuple[Ref, Ref]]] = {
    "operands in the other order": lambda b, x, f: (f, x),
    "with a gate": lambda b, x, f: (x, b.op("r", "mul.Tensor", (B, 4, 8), f, b.input("gate", B, 1, 8))),
    "parallel branches": lambda b, x, f: (x, b.op("r", "add.Tensor", (B, 4, 8), f, _beside(b, x))),
}


@pytest.mark.parametrize("how", SUMMANDS)
def test_all_that_is_added_to_the_stream_is_the_residual(how: str) -> None:
    b = Builder()
    x = b.input("x", B, 4, 8)
    first, second = SUMMANDS[how](b, x, b.op("f", "linear.default", (B, 4, 8), x, b.constant("w", 8, 8)))
    (block,) = find_residual_blocks(b.graph(b.op("a", "add.Tensor", (B, 4, 8), first, second)), "x").blocks
    assert (block.stream, block.residual) == ("x", "r" if second != x else "f")


def test_a_split_is_no_stream() -> None:
    """Its first part has the stream's type, and everything goes through it."""
    b = Builder()
    wide = b.op("wide", "linear.default", (B, 4, 16), b.input("x", B, 4, 2), b.constant("w", 16, 2))
    part = TensorType((B, 4, 8), "float32")
    b.nodes.append(Node("split", "aten.split.Tensor", (wide, 8, -1), (), (part, part)))
    b.nodes += [Node(f"part{i}", GETITEM, (Ref("split"), i), (), (part,)) for i in range(2)]
    h = b.residual("a", b.op("sum", "add.Tensor", (B, 4, 8), Ref("part0"), Ref("part1")))
    (block,) = find_residual_blocks(b.graph(h), "x").blocks
    assert (block.stream, block.residual) == ("sum", "a.f")


def test_no_residual_is_refused_and_says_where_the_search_ended() -> None:
    b = Builder()
    h = b.op("first", "linear.default", (B, 4, 8), b.input("x", B, 4, 8), b.constant("w", 8, 8))
    h = b.op("last", "gelu.default", (B, 4, 8), h)
    with pytest.raises(NoResidualBlocksError, match=r"ended at %first = aten.linear.default \(toy.py:0\)"):
        find_residual_blocks(b.graph(h), "x")


def test_output_that_ignores_the_sample_is_refused() -> None:
    b = Builder()
    b.input("x", B, 4, 8)
    other = b.op("y", "neg.default", (B, 4, 8), b.input("cond", B, 4, 8))
    with pytest.raises(PassError, match="does not depend on the sample") as refused:
        find_residual_blocks(b.graph(other), "x")
    assert not isinstance(refused.value, NoResidualBlocksError), "there is no network to make one block of"


def test_addition_of_a_constant_is_no_block() -> None:
    b = Builder()
    x = b.input("x", B, 4, 8)
    h = b.op("shifted", "add.Tensor", (B, 4, 8), x, b.constant("position", 1, 4, 8))
    with pytest.raises(
        NoResidualBlocksError, match=r"%shifted .*added %position does not depend on the residual stream"
    ):
        find_residual_blocks(b.graph(h), "x")


def test_addition_of_a_constant_between_blocks_makes_the_next_one_coarse_with_its_reason() -> None:
    b = Builder()
    h = b.residual("a0", b.input("x", B, 4, 8))
    h = b.op("shifted", "add.Tensor", (B, 4, 8), h, b.constant("position", 1, 4, 8))
    table = find_residual_blocks(b.graph(b.residual("a1", h)), "x")
    assert [(blk.stream, blk.result, blk.residual) for blk in table.blocks] == [("x", "a0", "a0.f"), ("a0", "a1", None)]
    assert "changed by %shifted = aten.add.Tensor" in table.blocks[1].reason
    assert any("merged" in reason for reason in table.declined)


def test_a_long_skip_makes_one_coarse_block() -> None:
    """x -> a0 -> a1 -> (a1 + a0) -> a2: nothing between a0 and the join can be cached on its own."""
    b = Builder()
    start = b.op("embed", "linear.default", (B, 4, 8), b.input("x", B, 4, 2), b.constant("w_in", 8, 2))
    inner = b.residual("a0", start)
    deep = b.residual("a1", inner)
    joined = b.op("joined", "cat.default", (B, 4, 16), (inner, deep), 2)
    merged = b.op("merged", "linear.default", (B, 4, 8), joined, b.constant("w_skip", 8, 16))
    table = find_residual_blocks(b.graph(b.residual("a2", merged)), "x")
    assert [(blk.stream, blk.result) for blk in table.blocks] == [("embed", "a0"), ("a0", "a2")]
    assert table.blocks[1].residual is None
    assert "the residual stream is changed by %a1.f = aten.linear.default" in table.blocks[1].reason
    assert any("a1" in reason and "around it" in reason for reason in table.declined)


def test_a_skip_over_the_whole_stack_starts_at_the_embedding() -> None:
    b = Builder()
    start = b.op("embed", "linear.default", (B, 4, 8), b.input("x", B, 4, 2), b.constant("w_in", 8, 2))
    one = b.residual("a0", start)
    two = b.residual("a1", one)
    joined = b.op("joined", "cat.default", (B, 4, 16), (start, two), 2)
    merged = b.op("merged", "linear.default", (B, 4, 8), joined, b.constant("w_skip", 8, 16))
    table = find_residual_blocks(b.graph(b.residual("a2", merged)), "x")
    assert [(blk.stream, blk.result) for blk in table.blocks] == [("embed", "merged"), ("merged", "a2")]
    assert "skip connection goes around" in table.blocks[0].reason


def test_a_broadcast_residual_is_declined() -> None:
    b = Builder()
    x = b.residual("a0", b.input("x", B, 4, 8))
    pooled = b.op("pooled", "mean.dim", (B, 1, 8), x, (1,), True)
    table = find_residual_blocks(b.graph(b.op("out", "add.Tensor", (B, 4, 8), x, pooled)), "x")
    assert len(table.blocks) == 1
    assert any("broadcast" in reason for reason in table.declined)


def test_residuals_of_an_embedding_of_another_width_are_no_blocks() -> None:
    b = Builder()
    narrow = b.residual("e0", b.input("x", B, 4, 2), width=2)
    h = b.op("widen", "linear.default", (B, 4, 8), narrow, b.constant("w", 8, 2))
    table = find_residual_blocks(b.graph(b.residual("a1", b.residual("a0", h))), "x")
    assert [blk.result for blk in table.blocks] == ["a0", "a1"]
    assert any("%e0" in reason for reason in table.declined)


def _attention(keys_from_stream: bool) -> Graph:
    b = Builder()
    x, context = b.input("x", B, 4, 8), b.input("context", B, 4, 8)
    source = x if keys_from_stream else context
    scores = b.op("scores", "matmul.default", (B, 4, 4), x, b.op("keys", "transpose.int", (B, 8, 4), source, 1, 2))
    weights = b.op("weights", "softmax.int", (B, 4, 4), scores, -1)
    mixed = b.op("mixed", "matmul.default", (B, 4, 8), weights, source)
    return b.graph(b.op("a", "add.Tensor", (B, 4, 8), x, mixed))


@pytest.mark.parametrize(("own", "kind"), [(True, "self_attention"), (False, "cross_attention")])
def test_kind_of_attention_written_out_by_hand(own: bool, kind: str) -> None:
    assert kinds(_attention(own)) == [kind]


def test_what_computes_beside_an_attention_is_in_its_name() -> None:
    graph = _attention(keys_from_stream=True)
    b = Builder()
    b.inputs, b.nodes = dict(graph.inputs), list(graph.nodes[:-1])
    beside = b.op("beside", "linear.default", (B, 4, 8), Ref("x"), b.constant("w", 8, 8))
    both = b.op("both", "add.Tensor", (B, 4, 8), Ref("mixed"), beside)
    assert kinds(b.graph(b.op("a", "add.Tensor", (B, 4, 8), Ref("x"), both))) == ["self_attention+feed_forward"]


def test_values_that_are_projected_by_a_path_of_their_own_belong_to_the_attention() -> None:
    b = Builder()
    x = b.input("x", B, 4, 8)
    scores = b.op("scores", "matmul.default", (B, 4, 4), x, b.op("keys", "transpose.int", (B, 8, 4), x, 1, 2))
    weights = b.op("weights", "softmax.int", (B, 4, 4), scores, -1)
    values = b.op("values", "linear.default", (B, 4, 8), x, b.constant("w", 8, 8))
    mixed = b.op("mixed", "matmul.default", (B, 4, 8), weights, values)
    assert kinds(b.graph(b.op("a", "add.Tensor", (B, 4, 8), x, mixed))) == ["self_attention"]


@pytest.mark.parametrize(("kernel", "kind"), [(1, "feed_forward"), (3, "network")])
def test_a_pointwise_convolution_is_a_linear_layer(kernel: int, kind: str) -> None:
    b = Builder()
    x = b.input("x", B, 8, 4)
    f = b.op("f", "conv1d.default", (B, 8, 4), x, b.constant("w", 8, 8, kernel))
    (found,) = kinds(b.graph(b.op("a", "add.Tensor", (B, 8, 4), x, f)))
    assert found.startswith(kind)


def test_a_structure_that_is_not_known_is_the_network_only_if_it_holds_all_that_is_computed() -> None:
    b = Builder()
    h = b.input("x", B, 8, 4)
    for i in range(2):
        f = b.op(f"f{i}", "conv1d.default", (B, 8, 4), h, b.constant(f"w{i}", 8, 8, 3))
        h = b.op(f"a{i}", "add.Tensor", (B, 8, 4), h, f)
    first, second = kinds(b.graph(h))
    assert first == second
    assert first.startswith("1ops_")


def test_coarse_blocks_share_no_cache_with_plain_ones() -> None:
    b = Builder()
    h = b.residual("a0", b.input("x", B, 4, 8))
    for i in (1, 2):
        h = b.residual(f"a{i}", b.op(f"n{i}", "layer_norm.default", (B, 4, 8), h, (8,)))
    table = find_residual_blocks(b.graph(h), "x")
    assert [(block.kind, block.group) for block in table.blocks] == [("feed_forward", g) for g in (0, 1, 1)]


def test_unknown_structures_get_equal_signatures_for_equal_structure() -> None:
    b = Builder()
    h = b.input("x", B, 4, 8)
    for i in range(2):
        h = b.op(f"a{i}", "add.Tensor", (B, 4, 8), h, b.op(f"f{i}", "sin.default", (B, 4, 8), h))
    h = b.op("a2", "add.Tensor", (B, 4, 8), h, b.op("f2", "cos.default", (B, 4, 8), h))
    table = find_residual_blocks(b.graph(h), "x")
    assert table.blocks[0].kind == table.blocks[1].kind != table.blocks[2].kind
    assert [blk.group for blk in table.blocks] == [0, 0, 1]


class _Decoder(nn.Module):
    """A decoder whose attribute names say nothing."""

    def __init__(self) -> None:
        super().__init__()
        make = nn.TransformerDecoderLayer
        self.q = nn.ModuleList(make(16, 2, 32, 0.0, "gelu", batch_first=True, norm_first=True) for _ in range(2))
        self.i, self.o = nn.Linear(2, 16), nn.Linear(16, 2)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        h = self.i(sample) + timestep[:, None, None].float()
        for layer in self.q:
            h = layer(h, obs)
        return self.o(h)


@pytest.mark.slow
def test_a_captured_decoder_has_three_blocks_a_layer() -> None:
    from ttscompile.capture.export import capture

    graph, _ = capture(_Decoder(), toy_spec(sample=(4, 2), obs=(3, 16)))
    table = find_residual_blocks(graph, "sample")
    assert [b.kind for b in table.blocks] == ["self_attention", "cross_attention", "feed_forward"] * 2


def test_a_chain_that_holds_little_of_the_work_is_none() -> None:
    """A residual of 8 channels beside a network of 64 around which a skip goes, as in a U-Net."""
    b = Builder()
    h = b.residual("a0", b.op("embed", "linear.default", (B, 4, 8), b.input("x", B, 4, 2), b.constant("in", 8, 2)))
    wide = b.op("wide", "linear.default", (B, 4, 64), h, b.constant("w", 64, 8))
    deep = b.op("deep", "linear.default", (B, 4, 64), wide, b.constant("v", 64, 64))
    joined = b.op("joined", "mul.Tensor", (B, 4, 64), wide, deep)
    graph = b.graph(b.op("out", "linear.default", (B, 4, 2), joined, b.constant("out_w", 2, 64)))
    with pytest.raises(
        NoResidualBlocksError, match=r"a chain of 1 block, which holds [0-3]% of .* expected 50% or more"
    ):
        find_residual_blocks(graph, "x")
