"""What a policy is between the passes: captured, cut into pieces, and hoisted. Each phase is a record of its own."""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar, cast

from ..core.coercion import Arrays
from ..core.spec import PolicySpec
from .graph import Graph, TensorType
from .pieces import CONDITION, FRAMES, PRUNER, SCENE, STEM, STEP, TAIL, LoopPiece, block_name, frame_name

Value = TypeVar("Value")
"""Whatever a runtime computes with."""

DENOISER, PROLOGUE = "denoiser", "prologue"
"""Graphs that are no pieces: one whole evaluation; and what it does before it reads the sample, until it is hoisted."""


class Binding(enum.Enum):
    """When a value is known; DESIGN section 3, ``hoist``."""

    CONSTANT = "constant"  # weights and what follows from them: at compile time
    TABLE = "table"  # also from the timestep: at compile time, one row for each step k
    CONDITION = "condition"  # from the observation: once a call
    STEP = "step"  # from observation and timestep: once a call, all K steps in one batch
    LOOP = "loop"  # from the noisy sample: inside the loop


@dataclass(frozen=True)
class Block:
    """One residual block ``x <- x + f(x, context)``.

    Attributes:
        kind: self_attention, cross_attention, feed_forward or a structural signature.
        stream: value that flows in, a_{i-1}.
        result: value that flows out, a_i.
        residual: value that is added; None for a coarse block, whose residual is result - stream.
        type: of stream, residual and result.
        group: number of its FORWARD group: blocks of one kind and one shape.
        reason: why it is coarse; empty for a plain residual.
    """

    index: int
    kind: str
    stream: str
    result: str
    residual: str | None
    type: TensorType
    group: int
    reason: str = ""


@dataclass(frozen=True)
class Loop:
    """The pieces that run at every step. What they read beside the residual stream are contexts."""

    stem: LoopPiece
    blocks: tuple[LoopPiece, ...]
    tail: LoopPiece

    @property
    def loop(self) -> dict[str, LoopPiece]:
        """Stem, blocks and tail by name, in the order of execution."""
        return {STEM: self.stem, **{block_name(b): piece for b, piece in enumerate(self.blocks)}, TAIL: self.tail}

    @property
    def contexts(self) -> tuple[str, ...]:
        """Names of all contexts, in the order of first use."""
        return tuple(dict.fromkeys(name for piece in self.loop.values() for name in piece.contexts))

    def graphs(self) -> dict[str, Graph]:
        """Every graph by name."""
        return {name: piece.graph for name, piece in self.loop.items()}


@dataclass(frozen=True)
class Pieces(Loop):
    """All pieces of a hoisted program.

    Attributes:
        condition: observations and what ``towers`` and ``scene`` give -> condition values, once a call.
        step: condition values and table rows -> step values; run with a batch of K*B, step-major. None if there are
            no step values.
        pruner: condition values -> logits ``[B, K, blocks, 4]``; None before ``InsertPruner``.
        tables: value of each TABLE context for every step of the original loop, ``[K, ...]`` with a batch of one in its
            batch axis.
        bindings: binding of every context of the loop pieces and of ``step``.
        features: condition values that the pruner reads.
        frames: observations -> the rows of each tower ``[m * B, ...]``, in their order; None without towers.
        towers: frame pieces: a row -> what depends on it alone, for any number of rows. What they give for all rows
            are inputs of ``condition`` or ``scene``.
        scene: observations but for rows of numbers, such as the state, and what ``towers`` give -> condition values and
            inputs of ``condition``, all with the axis of streams first. None where that is little work.
        tokens: for towers that have tokens, by name: ``pixels_00``, row -> what patches are cut from; and
            ``tokens_00``, the tower for some of its tokens, of one row. There the symbolic size is their number.
        loop_tables: by further loop, what ``tables`` has for the original.
        loop_pruners: by further loop, the pruner of a loop that has another number of steps; the constants have the
            names that those of ``pruner`` have.
    """

    condition: Graph
    step: Graph | None = None
    pruner: Graph | None = None
    tables: Arrays = field(default_factory=dict)
    bindings: Mapping[str, Binding] = field(default_factory=dict)
    features: tuple[str, ...] = ()
    frames: Graph | None = None
    towers: tuple[Graph, ...] = ()
    scene: Graph | None = None
    tokens: Mapping[str, Graph] = field(default_factory=dict)
    loop_tables: Mapping[str, Arrays] = field(default_factory=dict)
    loop_pruners: Mapping[str, Graph] = field(default_factory=dict)

    @property
    def rows(self) -> tuple[int, ...]:
        """How many rows of each tower a stream has."""
        types = {} if self.frames is None else self.frames.types()
        return tuple(types[next(iter(tower.inputs))].at(1)[0] for tower in self.towers)

    @property
    def conditions(self) -> dict[str, TensorType]:
        """Name and type of the condition values, those of ``scene`` first."""
        read = {*self.bindings, *self.features, *self.condition.outputs}
        parts = [(one.outputs, one.types()) for one in (self.scene, self.condition) if one is not None]
        return {name: types[name] for outputs, types in parts for name in outputs if name in read}

    def graphs(self) -> dict[str, Graph]:
        """Every graph by the name of its piece."""
        late = {STEP: self.step, PRUNER: self.pruner}
        after = {n: graph for n, graph in late.items() if graph is not None}
        return {**self.once(), **after, **self.tokens, **super().graphs()}

    def once(self) -> dict[str, Graph]:
        """The graphs that the observation alone decides, by the name of their piece, in order."""
        rows = {} if self.frames is None else {FRAMES: self.frames}
        towers = {frame_name(i): tower for i, tower in enumerate(self.towers)}
        scene = {} if self.scene is None else {SCENE: self.scene}
        return {**rows, **towers, **scene, CONDITION: self.condition}

    def in_loop(self, name: str) -> Pieces:
        """Those of one loop alone, as of the original."""
        tables, pruner = self.loop_tables.get(name, self.tables), self.loop_pruners.get(name, self.pruner)
        return replace(self, tables=tables, pruner=pruner, loop_tables={}, loop_pruners={})


def mapped(record: Value, function: Callable[[Graph], Graph]) -> Value:
    """A record of this module with another graph in place of each that it holds; the residual stream's inputs stay."""
    made: Any = record
    match made:
        case Graph():
            made = function(made)
        case LoopPiece() | Loop() | Phase():
            made = replace(made, **{each.name: mapped(getattr(made, each.name), function) for each in fields(made)})
        case tuple():
            made = tuple(mapped(one, function) for one in made)
        case Mapping():
            made = {name: mapped(one, function) for name, one in made.items()}
    return cast(Value, made)


def once_values(
    pieces: Pieces, run: Callable[[str, Mapping[str, Value]], Sequence[Value]], obs: Mapping[str, Value]
) -> dict[str, Value]:
    """What the observation alone decides, step values left out, by name: towers run on the rows of all streams."""
    found: dict[str, Value] = {}
    for name, graph in pieces.once().items():
        if graph.outputs:
            given = {each: found[each] if each in found else obs[each] for each in graph.inputs}
            found |= zip(graph.outputs, run(name, given), strict=True)
    return found


@dataclass(frozen=True)
class Phase:
    """What every phase has.

    Attributes:
        denoiser: graph of one evaluation: inputs sample, timestep, observations; output the prediction.
        weights: value of every constant of every graph.
        dense_flops: of one call in the original loop as the module makes it: K evaluations, one stream.
        once_flops: those of them that are of an observation encoder, which the module evaluates once a call.
        unmoved: ``spec`` with the samplers' tables for what the module predicts, where that is the sample plus what the
            denoiser predicts (``MoveSkip``); None where both predict the same, and ``spec`` has these tables.
    """

    spec: PolicySpec
    denoiser: Graph
    weights: Arrays
    dense_flops: int = field(default=0, kw_only=True)
    once_flops: int = field(default=0, kw_only=True)
    unmoved: PolicySpec | None = field(default=None, kw_only=True)

    def graphs(self) -> dict[str, Graph]:
        """Every graph by name."""
        return {DENOISER: self.denoiser}

    @property
    def carried(self) -> dict[str, Any]:
        """Its fields, by name, for the phase that follows."""
        return {each.name: getattr(self, each.name) for each in fields(Phase)}

    def flops_of(self, loop: str) -> int:
        """``dense_flops`` of a call in this loop."""
        own, steps = self.spec.sampler.steps, self.spec.all_loops[loop].steps
        return (self.dense_flops - self.once_flops) * steps // own + self.once_flops


@dataclass(frozen=True)
class Captured(Phase):
    """The denoiser as capture gives it, in one graph."""


@dataclass(frozen=True)
class Cut(Phase):
    """The denoiser cut along its residual stream (``Partition``).

    Attributes:
        prologue: observations and timestep -> contexts: what the loop reads and does not compute.
    """

    blocks: tuple[Block, ...]
    prologue: Graph
    loop: Loop

    def graphs(self) -> dict[str, Graph]:
        """Every graph by name."""
        return {**super().graphs(), PROLOGUE: self.prologue, **self.loop.graphs()}


@dataclass(frozen=True)
class Program(Phase):
    """The denoiser in pieces that each run when what they read is known (``Hoist``): what is lowered and executed.

    Attributes:
        loop_weights: by further loop, values of the constants of its pruner, where it has one of its own.
    """

    blocks: tuple[Block, ...]
    pieces: Pieces
    loop_weights: Mapping[str, Arrays] = field(default_factory=dict)

    def graphs(self) -> dict[str, Graph]:
        """Every graph by name."""
        return {**super().graphs(), **self.pieces.graphs()}

    def in_loop(self, name: str) -> Program:
        """The program of one loop alone, as if it were the original. Raises SpecError: there is no such loop."""
        return replace(
            self,
            spec=self.spec.in_loop(name),
            pieces=self.pieces.in_loop(name),
            weights={**self.weights, **self.loop_weights.get(name, {})},
            loop_weights={},
            dense_flops=self.flops_of(name),
            unmoved=None if self.unmoved is None else self.unmoved.in_loop(name),
        )
