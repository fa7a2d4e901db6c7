"""Names and interfaces of the pieces that a compiled denoiser is cut into.

A piece is a graph that runs as a whole. Its name is the key of its graph in a program, of its ONNX model, of its record
in the manifest and of its session. Values between pieces have the names that they have in the captured denoiser;
inputs and outputs that no denoiser has are named here.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from ..core.spec import SamplerTable
from .graph import Graph, TensorType

CONDITION = "condition"
"""Observations, and what frame pieces give -> condition values, once a call."""

FRAMES: Final = "frames"
"""Observations -> the rows of each frame piece, one a frame, by moving numbers; not every policy has it."""

SCENE: Final = "scene"
"""Observations that are no numbers of the robot's, and what frame pieces give -> condition values, and what the
condition piece reads; not every policy has it."""

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
"""Any one of the blocks, chosen at each run (``Joint``)."""

DENSE_STEP = "dense_step"
"""All blocks, one after the other (``Joint``)."""

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

PIXELS, INDEX, PLACES, ROWS = "tokens.pixels", "tokens.index", "tokens.places", "tokens.rows"
NOT_KEPT = (PIXELS, INDEX, PLACES, ROWS)
"""What a piece for some tokens reads beside what is kept: what patches are cut from, the numbers of the tokens that are
computed, and where rows go: token ``places[i]`` gets the row of the ``rows[i]``-th of these. No captured value has a
dot in its name."""


def renewed_name(kept: str) -> str:
    """What a piece for some tokens gives for something that is kept: all of it, with new rows for these tokens."""
    return f"{kept}.new"


def kept_inputs(graph: Graph) -> dict[str, TensorType]:
    """What a piece for some tokens keeps, by input, ``[T, ...]`` each."""
    return {name: type_ for name, type_ in graph.inputs.items() if renewed_name(name) in graph.outputs}


def pixels_name(piece: str) -> str:
    """``pixels_00`` of ``frame_00``: its row to what patches are cut from; ``pixels_scene``: to the sequence."""
    return _PIXELS + piece.removeprefix(_FRAME)


def tokens_name(piece: str) -> str:
    """``tokens_00`` of ``frame_00``, or ``tokens_scene``: the piece for some of its tokens."""
    return _TOKENS + piece.removeprefix(_FRAME)


def of_tokens(piece: str) -> bool:
    """Whether a piece is there for the sake of single tokens: no call needs it that computes all of them."""
    return piece.startswith((_PIXELS, _TOKENS))


def is_tokens(piece: str) -> bool:
    """Whether a piece is a frame piece, or the scene, for some of its tokens."""
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
        pieces that are always in fp32: they are small, or no call needs them. A piece for some tokens belongs to the
        part of the piece for all of them, and so does what makes a scene's sequence: it may read an embedding.
    """
    if is_block(piece) or piece in OF_ALL_BLOCKS:
        return BLOCKS
    if piece in (pixels_name(SCENE), tokens_name(SCENE)):
        return SCENE
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
    """Outputs of ``dense_step``: the residual stream after the last block, and what each of them added."""
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
        """Of the residual stream that flows in."""
        return self.graph.inputs[self.stream]

    @property
    def contexts(self) -> dict[str, TensorType]:
        """Name and type of the values that it reads beside the residual stream, in order."""
        return {name: type_ for name, type_ in self.graph.inputs.items() if name != self.stream}

    @property
    def result(self) -> str:
        """Name of the output."""
        return self.graph.outputs[0]


@dataclass(frozen=True)
class Joint:
    """How one graph holds all residual blocks: which inputs they share, and how a run says which block it wants.

    onnxruntime's threads belong to a session. With a session a block they cannot be kept awake from one block to the
    next; with one session for all blocks they can. Its graph is a tree of ``If`` nodes over a few booleans::

        which.0 --If--+-- which.1 --If--+-- block 0
                      |                 +-- block 1
                      +-- which.1 --If--+-- block 2
                                        +-- block 3

    Steps that compute all blocks have a graph of their own, in which nothing is between one block and the next::

        stream --block 0--> residual.0, stream + residual.0 --block 1--> residual.1, ... --> stream_next

    Attributes:
        slots: inputs that carry contexts, and their types; a block reads some of them.
        places: for each block its contexts in order, as names of slots.
        turns: for each block the values of ``which.0``, ``which.1``, ...; true takes the first branch.
    """

    slots: tuple[tuple[str, TensorType], ...]
    places: tuple[tuple[str, ...], ...]
    turns: tuple[tuple[bool, ...], ...]

    @property
    def switches(self) -> tuple[str, ...]:
        """Names of the booleans."""
        return tuple(f"which.{i}" for i in range(len(self.turns[0])))

    @property
    def inputs(self) -> tuple[str, ...]:
        """All inputs, in order."""
        return (*self.switches, STREAM, *(name for name, _ in self.slots))


def join(contexts: Iterable[Sequence[TensorType]]) -> Joint:
    """The interface for blocks whose contexts have these types; blocks share slots of one type."""
    slots: dict[tuple[TensorType, int], str] = {}
    places = []
    for types in contexts:
        own: list[tuple[TensorType, int]] = []
        for type_ in types:
            own.append((type_, sum(seen == type_ for seen, _ in own)))
        places.append(tuple(slots.setdefault(key, f"context.{len(slots)}") for key in own))
    turns, depth = list(_turns(0, len(places))), max(len(places) - 1, 0).bit_length()
    return Joint(
        slots=tuple((name, type_) for (type_, _), name in slots.items()),
        places=tuple(places),
        turns=tuple((*own, *[False] * (depth - len(own))) for own in turns),
    )


def halves(first: int, stop: int) -> int:
    """Where the range of blocks of a node of the tree is parted."""
    return (first + stop) // 2


def _turns(first: int, stop: int) -> Iterator[tuple[bool, ...]]:
    """The way to each of these blocks."""
    if stop - first == 1:
        yield ()
    elif stop > first:
        middle = halves(first, stop)
        yield from ((True, *rest) for rest in _turns(first, middle))
        yield from ((False, *rest) for rest in _turns(middle, stop))
