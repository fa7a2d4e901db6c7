"""The model of all blocks: any of them, chosen by a few booleans, gives what its own model gives."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from tests.runtimes.toys import f32, toy_program
from ttscompile.ir.graph import Batch
from ttscompile.ir.pieces import RESIDUAL, STREAM, join
from ttscompile.lower.program import lower_program

from .sessions import session


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [1, 2, 3, 5, 8])
def test_each_block_is_what_its_own_model_is(blocks: int) -> None:
    program = toy_program(blocks=blocks)
    models = lower_program(program)
    pieces = program.pieces
    joint = join([tuple(piece.contexts.values()) for piece in pieces.blocks])
    weights = {name: torch.from_numpy(np.asarray(value)) for name, value in program.weights.items()}
    whole = session(models["blocks"], weights)
    assert [value.name for value in whole.get_inputs()] == list(joint.inputs)
    rng = np.random.default_rng(0)
    feeds = {name: rng.standard_normal(type_.at(3)).astype(np.float32) for name, type_ in joint.slots}
    feeds[STREAM] = rng.standard_normal((3, 3, 4)).astype(np.float32)
    residuals = []
    for b, piece in enumerate(pieces.blocks):
        turns = {name: np.array(turn) for name, turn in zip(joint.switches, joint.turns[b], strict=True)}
        (found,) = whole.run([RESIDUAL], feeds | turns)
        own = {name: feeds[slot] for name, slot in zip(piece.contexts, joint.places[b], strict=True)}
        (expected,) = session(models[f"block_{b:02d}"], weights).run(None, own | {piece.stream: feeds[STREAM]})
        np.testing.assert_array_equal(found, expected)
        residuals.append(found)
    assert all(np.abs(left - right).max() > 1e-3 for left, right in pairwise(residuals))


def test_blocks_share_the_places_of_contexts_of_one_type() -> None:
    keys, wide = f32(Batch(), 4), f32(Batch(), 9)
    joint = join([(), (keys, keys), (wide,), (keys, wide, keys), (keys,)])
    assert joint.slots == (("context.0", keys), ("context.1", keys), ("context.2", wide))
    assert joint.places == (
        (),
        ("context.0", "context.1"),
        ("context.2",),
        ("context.0", "context.2", "context.1"),
        ("context.0",),
    )
    assert joint.inputs == ("which.0", "which.1", "which.2", STREAM, "context.0", "context.1", "context.2")


@pytest.mark.parametrize("count", range(1, 40))
def test_no_two_blocks_are_found_in_one_place(count: int) -> None:
    """A block is reached by its first turns; the rest of its turns, which nobody asks for, are false."""
    turns = join([()] * count).turns
    assert len(set(turns)) == count
    assert {len(each) for each in turns} == {max(count - 1, 0).bit_length()}
