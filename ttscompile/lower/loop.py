"""The denoising loop in ONNX: two loops, one in the other, and a question for every block that might be computed.

    for each step with a computed block:                                     Loop
        sums = coefficients @ residuals, one row a gap between computed blocks
        for each group of blocks, if any of it is computed:                  If
            for each block, if it is computed:                               If
                hidden += its gap's sum;  hidden += block(hidden)
        hidden += the last gap's sum;  advance
        for each step that follows without a computed block:                 Loop
            hidden += the step's sum, made again if it is another;  advance

Each block is in the model once, as the branch ``block_07`` beside the branch ``block_07_reused``. Weights lie in the
branch that reads them, where onnxruntime packs them. The loop is written anew here on purpose: the file runs without
the package, and its tests hold it against the runtimes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from onnx import GraphProto, ModelProto

from ..core.coercion import Arrays
from ..core.correction import INNER, MIDDLE, OUTER
from ..ir import pieces as names
from ..ir.program import Program
from .contexts import StreamContexts
from .graph_writer import GraphWriter, sequence, tensor
from .plan import LoweredPlan

GROUP = 6
"""Blocks that are skipped with one question where none of them is computed."""


@dataclass(frozen=True)
class LoopInputs:
    """Names of values that the loop reads; of all B streams, or of the S that follow one plan.

    Attributes:
        initial: sample at step 0, [B, T, D].
        offset: of the sampler's updates, [K, D, B, T].
        update: matrices of the sampler's updates, [K, G, R, (1 + S) T].
        plain: the same without a correction, [K, 1, R, (1 + S) T].
        anchors: bool [K]; after these steps sample and prediction enter the history.
        history: before step 0, [D, B, 4 T].
        memory: of the sampler, before step 0: [D, B, S T]; None if it has none.
        rows: rollout cache of all streams [R, A, C]; a row is the residual of one stream: A and C are the sizes before
            and after the axis of streams.
        index: int64 [K, N, B]; which row is the residual of a cell.
        jumps: int64 [K]; the number of the jump that is added after a step, -1 for none. None where the correction
            cannot have any. Their layers are inputs of the model (``core.correction``): INNER [J, N + 4 T D + 1, H],
            MIDDLE [J, H + 1, H], OUTER [J, H + 1, T D].
        condition: what jumps read beside the history, [B, N]; None where a correction cannot read it.
    """

    initial: str
    offset: str
    update: str
    plain: str
    anchors: str
    history: str
    memory: str | None
    rows: str
    index: str
    jumps: str | None
    condition: str | None


@dataclass(frozen=True)
class _State:
    """What a step hands to the next; the sample as ``[D, B, T]``; ``memory`` is empty or the sampler's memories."""

    sample: str
    hidden: str
    history: str
    memory: tuple[str, ...]

    @property
    def values(self) -> tuple[str, ...]:
        return (self.sample, self.hidden, self.history, *self.memory)


@dataclass(frozen=True)
class _Step:
    """Values of one step with computed blocks: its row of the members of ``LoweredPlan``, and ``sums [gaps, E]``."""

    k: str
    computed: str
    position: str
    in_step: str
    first_row: str
    sums: str


class DenoisingLoop:
    """Writes the loop of streams that follow one plan."""

    def __init__(
        self,
        main: GraphWriter,
        program: Program,
        models: Mapping[str, ModelProto],
        weights: Arrays,
        contexts: StreamContexts,
    ) -> None:
        self._main, self._models, self._weights, self._contexts = main, models, weights, contexts
        self._pieces, self._sampler = program.pieces, program.spec.sampler
        self._groups = [block.group for block in program.blocks]

    def write(self, plan: LoweredPlan, inputs: LoopInputs) -> tuple[str, str]:
        """Write stem and loop: the last sample ``[B, T, D]``, and computed residuals ``[computed, E]`` in order."""
        main = self._main
        self._plan, self._inputs = plan, inputs
        columns = {name: getattr(self._sampler, name)[:, None] for name in names.X0_COLUMNS}
        self._x0_columns = {name: main.constant(column, np.float32) for name, column in columns.items()}
        stem = self._feeds(main, self._pieces.stem, inputs.initial, main.constant(0))
        (hidden,) = main.inline(self._models[names.STEM], stem, self._weights)
        self._shape = main.op("Shape", hidden)
        width = main.op("ReduceProd", self._shape, keepdims=1)
        self._none = main.op("ConstantOfShape", main.op("Concat", main.constant([0]), width, axis=0))
        count = main.constant([len(self._groups)])
        table = main.op("ConstantOfShape", main.op("Concat", count, width, axis=0))
        memory = (inputs.memory,) if inputs.memory is not None else ()
        first = _State(main.op("Transpose", inputs.initial, perm=[2, 0, 1]), hidden, inputs.history, memory)
        carried = [*first.values, table, main.op("SequenceEmpty")]
        body = self._computed_step()
        state = main.ops("Loop", [plan.computed_steps, "", *carried], len(carried), body=body)
        sample = main.op("Transpose", state[0], perm=[1, 2, 0])
        return sample, main.op("ConcatFromSequence", state[-1], axis=0)

    def _computed_step(self) -> GraphProto:
        """Body of the outer loop: carries sample, stream, every block's last computed residual, and all computed."""
        w, plan = self._main.inner(), self._plan
        i, on, table, done = (w.fresh(n) for n in ("i", "on", "table", "done"))
        state = self._fresh_state(w)
        k = w.op("Gather", plan.steps, i)
        rows = (plan.computed, plan.position, plan.in_step, plan.first_row)
        computed, position, in_step, first_row = (w.op("Gather", row, k) for row in rows)
        step = _Step(k, computed, position, in_step, first_row, self._sums(w, k, table))
        value, made = state.hidden, list[str]()
        starts = range(0, len(self._groups), GROUP)
        flags = _flags(w, w.op("Gather", plan.any_of_group, k), range(len(starts)))
        for start, flag in zip(starts, flags, strict=True):
            members = range(start, min(start + GROUP, len(self._groups)))
            group, reused = self._group(step, value, made, members), self._reused(w, value, f"group_{start}")
            value, residuals = w.choose(flag, group, reused)
            made.append(residuals)
        last = w.op("Gather", step.sums, w.constant(-1))
        value = w.op("Add", value, w.op("Reshape", last, self._shape))
        value = self._add_in_step(w, step, value, made, len(self._groups))
        arrays = [tensor(name, np.float32) for name in (*state.values, table)]
        state = self._advance(w, replace(state, hidden=value), k)
        fresh = w.op("Concat", *made, axis=0)
        renewed = w.op("ScatterND", table, w.op("Transpose", w.op("NonZero", step.computed), perm=[1, 0]), fresh)
        idle = self._idle_step(w, k, renewed)
        after = w.ops("Loop", [w.op("Gather", plan.idle, i), "", *state.values, last], len(state.values) + 1, body=idle)
        more, all_made = w.op("Identity", on), w.op("SequenceInsert", done, fresh)
        results = [tensor(name, np.float32) for name in (*after[:-1], renewed)]
        return w.graph(
            "computed_step",
            [tensor(more, np.bool_), *results, sequence(all_made)],
            [tensor(i, np.int64, []), tensor(on, np.bool_, []), *arrays, sequence(done)],
        )

    def _idle_step(self, outer: GraphWriter, before: str, table: str) -> GraphProto:
        """Body of the inner loop: carries sample, stream, and what the step before added."""
        w, plan = outer.inner(), self._plan
        j, on, last = (w.fresh(n) for n in ("j", "on", "last"))
        state = self._fresh_state(w)
        arrays = [tensor(name, np.float32) for name in (*state.values, last)]
        k = w.op("Add", w.op("Add", before, j), w.constant(1))
        again, anew = w.inner(), w.inner()
        same = again.op("Identity", last)
        made = anew.op("Reshape", self._sums(anew, k, table), anew.constant([-1]))
        (total,) = w.choose(w.op("Gather", plan.same, k), again.body("again", same), anew.body("anew", made))
        value = w.op("Add", state.hidden, w.op("Reshape", total, self._shape))
        state = self._advance(w, replace(state, hidden=value), k)
        out = [w.op("Identity", on), *state.values, total]
        return w.graph(
            "idle_step",
            [tensor(out[0], np.bool_), *(tensor(name, np.float32) for name in out[1:])],
            [tensor(j, np.int64, []), tensor(on, np.bool_, []), *arrays],
        )

    def _sums(self, w: GraphWriter, k: str, table: str) -> str:
        """What the gaps of step k add, ``[gaps, E]``, without reads of residuals of the step itself."""
        plan, plain, mixed = self._plan, w.inner(), w.inner()
        bounds = [w.op("Unsqueeze", w.op("Gather", row, k), w.constant([0])) for row in (plan.first_row, plan.stop_row)]
        coefficients = w.op("Slice", plan.from_table, *bounds)
        total = plain.op("MatMul", coefficients, table)
        reads = mixed.op("Gather", plan.rollout, k)
        cells = mixed.op("Compress", mixed.op("Gather", self._inputs.index, k), reads, axis=0)  # [read, S]
        share = mixed.op("Compress", mixed.op("Slice", plan.from_rollout, *bounds), reads, axis=1)
        of_streams = mixed.op("Transpose", mixed.op("Gather", self._inputs.rows, cells), perm=[0, 2, 1, 3])
        older = mixed.op("MatMul", share, mixed.op("Reshape", of_streams, mixed.constant([0, -1])))
        both = mixed.op("Add", mixed.op("MatMul", coefficients, table), older)
        any_rollout = w.op("Gather", plan.any_rollout, k)
        return w.choose(any_rollout, mixed.body("mixed", both), plain.body("plain", total))[0]

    def _group(self, step: _Step, hidden: str, before: Sequence[str], members: range) -> GraphProto:
        """Neighbouring blocks of which some are computed; gives the residual stream and the computed residuals."""
        w = self._main.inner()
        value, made = hidden, list[str]()
        for b, flag in zip(members, _flags(w, step.computed, members), strict=True):
            block, reused = self._block(step, value, [*before, *made], b), self._reused(w, value, names.block_name(b))
            value, residual = w.choose(flag, block, reused)
            made.append(residual)
        return w.body(f"group_{members.start}", value, w.op("Concat", *made, axis=0))

    def _block(self, step: _Step, hidden: str, before: Sequence[str], b: int) -> GraphProto:
        """The gap before a computed block, and the block; gives the residual stream and the residual as a row."""
        w = self._main.inner()
        gap = w.op("Gather", step.sums, w.op("Gather", step.position, w.constant(b)))
        value = w.op("Add", hidden, w.op("Reshape", gap, self._shape))
        value = self._add_in_step(w, step, value, before, b)
        name, piece = names.block_name(b), self._pieces.blocks[b]
        (residual,) = w.inline(self._models[name], self._feeds(w, piece, value, step.k), self._weights)
        value = w.op("Add", value, residual)
        return w.body(name, value, w.op("Reshape", residual, w.constant([1, -1])))

    def _reused(self, w: GraphWriter, hidden: str, name: str) -> GraphProto:
        """The other branch: the residual stream as it is, and no residuals. What is reused is in the gaps' sums."""
        inner = w.inner()
        return inner.body(f"{name}_reused", inner.op("Identity", hidden), inner.op("Identity", self._none))

    def _add_in_step(self, w: GraphWriter, step: _Step, hidden: str, before: Sequence[str], b: int) -> str:
        """Add, in the gap before block b, FORWARD reads of residuals that the step itself has computed.

        The residuals of the blocks ``before`` b are rows of those that were computed; b is the number of blocks for the
        step's last gap.
        """
        if not any(group in self._groups[:c] for c, group in enumerate(self._groups[:b])):
            return hidden  # no block before b has one of its group before it
        plain, reads = w.inner(), w.inner()
        same = plain.op("Identity", hidden)
        gap = reads.op("Add", step.first_row, reads.op("Gather", step.position, reads.constant(b)))
        bounds = reads.constant([0]), reads.constant([b])
        row = reads.op("Slice", reads.op("Gather", self._plan.from_step, gap), *bounds)
        share = reads.op("Compress", row, reads.op("Slice", step.computed, *bounds))
        row = reads.op("Unsqueeze", share, reads.constant([0]))
        total = reads.op("MatMul", row, reads.op("Concat", *before, axis=0))
        added = reads.op("Add", hidden, reads.op("Reshape", total, self._shape))
        in_step = w.op("Gather", step.in_step, w.constant(b))
        return w.choose(in_step, reads.body("in_step", added), plain.body("plain", same))[0]

    def _fresh_state(self, w: GraphWriter) -> _State:
        memory = (w.fresh(names.MEMORY),) if self._sampler.memories else ()
        return _State(w.fresh("sample"), w.fresh("stream"), w.fresh("history"), memory)

    def _advance(self, w: GraphWriter, state: _State, k: str) -> _State:
        by_step = {names.OFFSET: self._inputs.offset, names.UPDATE: self._inputs.update, **self._x0_columns}
        feeds = {names.STREAM: state.hidden, names.SAMPLE: state.sample, names.HISTORY: state.history}
        feeds |= zip([names.MEMORY] * len(state.memory), state.memory, strict=True)
        feeds |= {name: w.op("Gather", values, k) for name, values in by_step.items()}
        if self._inputs.jumps is not None:
            feeds[names.OFFSET] = self._jumped(w, self._inputs.jumps, feeds[names.OFFSET], state.history, k)
        # The stem is of the next step; of the last one itself, whose stream nobody reads.
        following = w.op("Min", w.op("Add", k, w.constant(1)), w.constant(self._sampler.steps - 1))
        for name, piece, at in ((names.TAIL, self._pieces.tail, k), (names.STEM, self._pieces.stem, following)):
            for context, type_ in piece.contexts.items():
                feeds[names.advance_context(name, context)] = self._contexts.value(w, context, at, type_)
        sample, hidden, prediction, *memory = w.inline(self._models[names.ADVANCE], feeds, self._weights)
        is_anchor = w.op("Gather", self._inputs.anchors, k)
        history = self._remembered(w, is_anchor, state.sample, prediction, state.history)
        return _State(sample, hidden, history, tuple(memory))

    def _jumped(self, w: GraphWriter, jumps: str, offset: str, history: str, k: str) -> str:
        """The offset of step k with the jump that ends there, if one does: ``Correction.jump`` in ONNX."""
        jumping, staying = w.inner(), w.inner()
        j = w.op("Gather", jumps, k)
        flat = jumping.op("Reshape", jumping.op("Transpose", history, perm=[1, 0, 2]), jumping.constant([0, -1]))
        condition = self._inputs.condition
        value = flat if condition is None else jumping.op("Concat", condition, flat, axis=1)
        layers = [jumping.op("Gather", layer, j) for layer in (INNER, MIDDLE, OUTER)]
        zero, last, end = (jumping.constant([n]) for n in (0, -1, 2**31 - 1))

        def affine(value: str, layer: str) -> str:
            matrix, row = (jumping.op("Slice", layer, *ends, zero) for ends in ((zero, last), (last, end)))
            return jumping.op("Add", jumping.op("MatMul", value, matrix), row)

        for layer in layers[:-1]:
            value = jumping.op("Relu", affine(value, layer))
        value = affine(value, layers[-1])  # [B, D T], as the offset is [D, B, T]
        shape = jumping.op("Concat", jumping.constant([0]), jumping.op("Shape", offset, start=0, end=1), last, axis=0)
        added = jumping.op("Transpose", jumping.op("Reshape", value, shape), perm=[1, 0, 2])
        jumped, same = jumping.op("Add", offset, added), staying.op("Identity", offset)
        any_jump = w.op("GreaterOrEqual", j, w.constant(0))
        return w.choose(any_jump, jumping.body("jump", jumped), staying.body("no_jump", same))[0]

    def _remembered(self, w: GraphWriter, is_anchor: str, sample: str, prediction: str, history: str) -> str:
        """The history after a step: sample and prediction enter it if the step is an anchor, and the oldest leave."""
        anchor, other = w.inner(), w.inner()
        length = anchor.op("Mul", anchor.op("Shape", sample, start=2, end=3), anchor.constant([2]))
        kept = anchor.op("Slice", history, anchor.constant([0]), length, anchor.constant([2]))
        longer = anchor.op("Concat", sample, prediction, kept, axis=2)
        same = other.op("Identity", history)
        return w.choose(is_anchor, anchor.body("anchor", longer), other.body("other", same))[0]

    def _feeds(self, w: GraphWriter, piece: names.LoopPiece, hidden: str, k: str) -> dict[str, str]:
        """A value for each input of the stem or a block: the sample or stream, then contexts."""
        contexts = {name: self._contexts.value(w, name, k, type_) for name, type_ in piece.contexts.items()}
        return {piece.stream: hidden, **contexts}


def _flags(w: GraphWriter, vector: str, which: range) -> list[str]:
    part = w.op("Slice", vector, w.constant([which.start]), w.constant([which.stop]))
    return w.ops("Split", [part], len(which), axis=0, num_outputs=len(which))
