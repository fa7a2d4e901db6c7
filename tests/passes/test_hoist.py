"""What is left in the loop, and when the rest is computed."""

import pytest

from tests.passes.graphs import B
from tests.passes.modules import SHAPE, compiled, graph_inputs, hoisted
from ttscompile import ObservationSpec
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.graph import Ref
from ttscompile.ir.program import Binding
from ttscompile.ir.verify import verify


@pytest.mark.slow
def test_time_token_becomes_a_table_and_observation_tokens_are_encoded_once() -> None:
    _, program = compiled("tokens")
    pieces = program.pieces
    assert pieces.step is None
    # Keys and values of two layers: a table row for the time token, a condition value for the three observation tokens.
    assert len(pieces.tables) == 4
    assert all(table.shape[0] == 5 and table.shape[3] == 1 for table in pieces.tables.values())
    width, tokens = 16, 3
    encode = 2 * tokens * (7 * width + 2 * width * 32)
    keys_and_values = 2 * tokens * (2 * width * width) * 2
    assert graph_flops(pieces.condition) == encode + keys_and_values
    # Nothing but self-attention, queries, cross-attention itself, feed-forward, embedding and head is left in the loop.
    loop = sum(graph_flops(piece.graph) for piece in pieces.loop.values())
    attention = lambda keys: 2 * 4 * keys * 2 * width  # noqa: E731
    layer = (
        2 * 4 * width * (4 * width) + attention(4) + 2 * 4 * width * (2 * width) + attention(4) + 2 * 4 * 2 * width * 32
    )
    assert loop == 2 * layer + 2 * (2 * 4 * 2 * width)


@pytest.mark.slow
def test_a_mixing_condition_encoder_runs_all_steps_in_one_batch() -> None:
    _, program = compiled("condition encoder mixes tokens")
    assert program.pieces.step is not None
    assert Binding.STEP in program.pieces.bindings.values()


@pytest.mark.slow
def test_modulations_leave_the_loop() -> None:
    _, program = compiled("adaLN")
    pieces = program.pieces
    assert pieces.step is not None
    assert graph_flops(pieces.step) == 2 * 2 * 16 * 48
    assert [graph_flops(piece.graph) for piece in pieces.blocks] == [2 * 4 * 2 * 16 * 32] * 2


def test_a_network_without_products_is_hoisted() -> None:
    b, sample, obs = graph_inputs("float32")
    gate = b.op("gate", "mean.dim", (B, 1, 1), b.op("row", "unsqueeze.default", (B, 1, 3), obs, 1), (2,), True)
    residual = b.op("f", "tanh.default", SHAPE, b.op("g", "mul.Tensor", SHAPE, sample, gate))
    program = hoisted(b, b.op("y", "add.Tensor", SHAPE, sample, residual), ObservationSpec((3,)))
    assert [graph_flops(piece.graph) for piece in program.pieces.blocks] == [0]


def test_a_concatenation_of_another_one_is_made_in_the_loop_with_it() -> None:
    """A block reads both: the inner one, along tokens, and the outer one, along features."""
    b, sample, obs = graph_inputs("float32")
    time, first = b.op("time", "mul.Tensor", (B,), Ref("timestep"), 0.5), b.op("first", "mean.dim", (B,), obs, (1,))
    rows = []
    for name, value in (("t", time), ("o", first)):
        one = b.op(name, "reshape.default", (B, 1, 1), value, (B, 1, 1))
        rows.append(b.op(f"{name}.rows", "expand.default", (B, 2, 2), one, (B, 2, 2)))
    inner = b.op("inner", "cat.default", SHAPE, tuple(rows), 1)
    own = b.op("own", "expand.default", SHAPE, Ref("o"), SHAPE)
    outer = b.op("outer", "cat.default", (B, 4, 4), (inner, own), 2)
    twice = b.op("twice", "cat.default", (B, 4, 4), (sample, sample), 2)
    product = b.op("p", "mul.Tensor", (B, 4, 4), twice, outer)
    narrow = b.op("f", "linear.default", SHAPE, product, b.constant("w", 2, 4))
    residual = b.op("g", "mul.Tensor", SHAPE, narrow, inner)
    program = hoisted(b, b.op("y", "add.Tensor", SHAPE, sample, residual), ObservationSpec((3,)))
    verify(program)
    (block,) = program.pieces.blocks
    assert [node.name for node in block.graph.nodes if node.op == "aten.cat.default"] == ["inner", "outer", "twice"]
    assert program.pieces.step is None and set(block.contexts) == {"t.rows", "o.rows", "own"}
