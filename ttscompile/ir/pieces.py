"""Names and interfaces of the pieces that a compiled denoiser is cut into.

A piece is a graph that runs as a whole. Its name is the key of its graph in a program, of its ONNX model, of its record
in the manifest and of its session. Values between pieces have the names that they have in the captured denoiser;
inputs and outputs that no denoiser has are named here.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from ..core.spec import SamplerTable
from .graph import Graph, TensorType

CONDITION = "condition"
"""Observations, and what frame pieces give -> condition values, once a call."""

FRAMES: Final = "frames"
"""Observations -> the rows of each frame piece, one a frame, by moving numbers; not every policy has it."""

STEP = "step"
"""Condition values and table rows -> step values, for all K steps in one batch."""

PRUNER: Final = "pruner"
"""Condition values -> logits of the plan, once a call."""

USE_PRUNER: Final = "use_pruner"
"""Input of the single ONNX file of a call that says whether the pruner makes the plan."""

STEM = "stem"
"""Sample -> residual stream."""

TAIL = "tail"
"""Residual stream -> prediction."""

ADVANCE = "advance"
"""Tail, sampler update and the next step's stem in one (``lower.advance``)."""

_OF_LOOP = "@"


def of_loop(piece: str, loop: str) -> str:
    """``advance@ddim-16``: a piece of a further loop that differs from that of the original loop, which has its name.

    ``advance`` and the pruner may differ: of their samplers, and of their numbers of steps.
    """
    return f"{piece}{_OF_LOOP}{loop}"


def is_of_loop(piece: str) -> bool:
    """Whether a piece is of a further loop."""
    return _OF_LOOP in piece


JOINT = "blocks"
"""Any one of the blocks, chosen at each run (``ir.joint``)."""

DENSE_STEP = "dense_step"
"""All blocks, one after the other (``ir.joint``)."""

IDLE = "idle"
"""What steps need of the sum that they add where they compute no block (``ir.idle_form``); not every network has it."""

LAYERS: Final = "layers"
"""The results of the layers of a network that is one block (``ir.layers``); ``verify`` alone opens it."""

OF_ALL_BLOCKS = (JOINT, DENSE_STEP)
"""Pieces that hold all blocks once more."""

BLOCKS: Final = JOINT
"""The part of a policy that is all of its blocks (``part_of``)."""
_FRAME = "frame_"


def frame_name(index: int) -> str:
    """``frame_00``: a piece that works on one frame of one observation at a time, whatever the others are."""
    return f"{_FRAME}{index:02d}"


def frame_pieces(pieces: Iterable[str]) -> tuple[str, ...]:
    """Those of the pieces that are frame pieces, in order."""
    return tuple(sorted(piece for piece in pieces if piece.startswith(_FRAME)))


_PIXELS, _TOKENS = "pixels_", "tokens_"

PIXELS, INDEX = "tokens.pixels", "tokens.index"
"""What a piece for some tokens reads beside what is kept: what patches are cut from, and the numbers of the tokens. No
captured value has a dot in its name."""


def renewed_name(kept: str) -> str:
    """What a piece for some tokens gives for something that is kept: all of it, with new rows for these tokens."""
    return f"{kept}.new"


def pixels_name(index: int) -> str:
    """``pixels_00``: the row of a frame piece to what its patches are cut from."""
    return f"{_PIXELS}{index:02d}"


def tokens_name(index: int) -> str:
    """``tokens_00``: a frame piece for some of its tokens."""
    return f"{_TOKENS}{index:02d}"


def of_tokens(piece: str) -> bool:
    """Whether a piece is there for the sake of single tokens: no call needs it that computes whole frames."""
    return piece.startswith((_PIXELS, _TOKENS))


def is_tokens(piece: str) -> bool:
    """Whether a piece is a frame piece for some of its tokens."""
    return piece.startswith(_TOKENS)


_BLOCK = "block_"
_SMALL = frozenset({PRUNER, STEM, TAIL, ADVANCE, IDLE, LAYERS, FRAMES})


def block_name(index: int) -> str:
    """``block_07``: the piece of one residual block."""
    return f"{_BLOCK}{index:02d}"


def is_block(piece: str) -> bool:
    """Whether a piece is a residual block."""
    return piece.startswith(_BLOCK)


def part_of(piece: str) -> str | None:
    """Which part of a policy, of those that may each have a precision of their own, a piece belongs to.

    Returns:
        ``blocks`` for blocks and the pieces that hold all of them; the name of a piece of the prologue; and None for
        pieces that are always in fp32: they are small, or no call needs them. A frame piece for some tokens belongs to
        the part of the frame piece.
    """
    if is_block(piece) or piece in OF_ALL_BLOCKS:
        return BLOCKS
    if of_tokens(piece):
        return _FRAME + piece.removeprefix(_TOKENS) if is_tokens(piece) else None
    return None if piece.partition(_OF_LOOP)[0] in _SMALL else piece


def parts_of(pieces: Iterable[str]) -> tuple[str, ...]:
    """The parts that these pieces belong to, ``blocks`` first."""
    return tuple(dict.fromkeys((BLOCKS, *filter(None, map(part_of, pieces)))))


# Values that several pieces of the loop have.
STREAM, STREAM_NEXT, RESIDUAL = "stream", "stream_next", "residual"

# ``advance``: what is carried from a step to the next comes in pairs NAME and NAME_next.
SAMPLE, SAMPLE_NEXT = "sample", "sample_next"
MEMORY, MEMORY_NEXT = "memory", "memory_next"
OFFSET, HISTORY, UPDATE, PREDICTION = "offset", "history", "update", "prediction"
X0_COLUMNS = ("sample_to_x0", "out_to_x0")
"""Columns of the sampler's table that are inputs of their own."""


def advance_inputs(sampler: SamplerTable) -> tuple[str, ...]:
    """Inputs of ``advance`` that are no contexts, in order."""
    return (STREAM, SAMPLE, OFFSET, HISTORY, UPDATE, *X0_COLUMNS, *[MEMORY] * bool(sampler.memories))


def advance_outputs(sampler: SamplerTable) -> tuple[str, ...]:
    """Outputs of ``advance``, in order."""
    return (SAMPLE_NEXT, STREAM_NEXT, PREDICTION, *[MEMORY_NEXT] * bool(sampler.memories))


def advance_context(piece: str, name: str) -> str:
    """The input of ``advance`` for a context of its tail or its stem: ``tail.NAME``."""
    return f"{piece}.{name}"


CONTEXT = "context."
"""Before the name of a context it is the name of an input of ``dense_step``."""


def dense_step_outputs(blocks: int) -> tuple[str, ...]:
    """Outputs of ``dense_step``: the stream after the last block, and what each of them added."""
    return (STREAM_NEXT, *(f"{RESIDUAL}.{b:02d}" for b in range(blocks)))


TOTAL = "total"
"""Input of ``idle``: the sum of a step's residuals, of the type of the residual stream."""

BASE, PRODUCT, SHIFT = "base", "product", "shift"
IDLE_OUTPUTS = (BASE, PRODUCT, SHIFT)
"""``base [2 D + 1, B, T]``, what is added to ``product [2 D + 1, D] @ x``: rows of y, then those of the numerator; and
``shift [D, 1, T]``, what is added to the quotient. The last two depend on nothing. ``ir.idle_form`` says what y is."""


@dataclass(frozen=True)
class LoopPiece:
    """A piece that runs at every step: stem, a block, or tail.

    Attributes:
        stream: the input that carries the sample (of the stem) or the residual stream; the others are contexts.
    """

    graph: Graph
    stream: str

    @property
    def type(self) -> TensorType:
        """Of the stream that flows in."""
        return self.graph.inputs[self.stream]

    @property
    def contexts(self) -> dict[str, TensorType]:
        """Name and type of the values that it reads beside the stream, in order."""
        return {name: type_ for name, type_ in self.graph.inputs.items() if name != self.stream}

    @property
    def result(self) -> str:
        """Name of the output."""
        return self.graph.outputs[0]
