"""Memory of one batch size: every buffer that the denoising loop touches, and the sessions bound to them.

A block writes its residual to its row of ``current``, and nothing else of the call is kept: what TIMESTEP and FORWARD
read is always the last residual that some block computed. Entries of the rollout cache are copies, made only of those
that a later call can read. Sessions are bound once, before the first call: a block always reads the same residual
stream and the same context buffers, to which the values of the step are copied.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ttscompile.artifact.manifest import PieceRecord
from ttscompile.artifact.view import View
from ttscompile.core.coercion import Array
from ttscompile.core.correction import HISTORY, Correction, no_correction, remember
from ttscompile.core.spec import FloatArray, Noise
from ttscompile.core.update import matrices
from ttscompile.ir import pieces
from ttscompile.ir.pieces import ADVANCE, CONTEXT, DENSE_STEP, IDLE, PRUNER, STEM, STREAM, block_name
from ttscompile.runtimes.backend import fill_initial, fill_offset, hold_known, stream_type
from ttscompile.runtimes.contexts import ContextValues
from ttscompile.runtimes.inpainting import Known, MaskedUpdates

from .idle_steps import IdleSteps
from .sessions import FIRST_STEP, Bound, run_named, run_prologue

KEPT_CORRECTIONS = 64
"""Whose bindings a workspace keeps; there are two of each, with a prefix and without."""


class Workspace:
    """Buffers and bindings for B streams.

    ``stem`` and ``advance`` write a step's residual stream to ``fresh``; blocks and ``advance`` read ``hidden``. The
    sample has two buffers, taken in turn: step k reads that of ``k % 2``, and ``advance`` writes the other.

    Attributes:
        sample: two arrays ``[D, B, T]``.
        fresh: the residual stream as a step begins.
        hidden: the residual stream after what was added to it.
        current: float32 ``[blocks, *hidden]``, what each block computed last.
        table: float32 ``[blocks, *hidden]``, what each reused block adds at the moment.
        rollout: entries of the rollout cache by flat index ``k * blocks + b``: copies of computed residuals that a
            later call of the episode can read. One is made when it is first kept, and stays for the next episodes.
        idle: for steps without a computed block; None if the network is of another form.
        offset: what each step adds to the sample that is known before it, ``[K, D, B, T]``.
    """

    def __init__(self, view: View, sessions: Mapping[str, Any], streams: int) -> None:
        manifest = view.manifest
        kind = stream_type(manifest, streams)
        shape = kind.at(streams)
        self.streams, self._axis = streams, kind.batch_axis or 0
        self._manifest, self._sessions = manifest, sessions
        self._steps, count = manifest.steps, len(manifest.blocks)
        horizon, dimensions = manifest.spec.sample
        self.sample = [np.zeros((dimensions, streams, horizon), np.float32) for _ in range(2)]
        self._initial = np.zeros((streams, horizon, dimensions), np.float32)
        self.fresh, self.hidden = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self.current = np.zeros((count, *shape), np.float32)
        self.table = np.zeros((count, *shape), np.float32)
        self.rollout: dict[int, Array] = {}
        self._sums = np.zeros((0, *shape), np.float32)
        self._sampler = manifest.spec.sampler
        self.offset = np.zeros((self._steps, dimensions, streams, horizon), np.float32)
        self._contexts = ContextValues(manifest, streams, np, np.zeros, view.tables)
        stem = manifest.pieces[STEM]
        assert stem.stream is not None
        at_first = {name: self._contexts.at(name, 0) for name in stem.contexts}
        self._stem = Bound(sessions[STEM], {stem.stream: self._initial, **at_first}, {stem.outputs[0]: self.fresh})
        self._history = np.zeros((dimensions, streams, HISTORY * horizon), np.float32)
        size = self._sampler.memories * horizon
        self._memory = [np.zeros((dimensions, streams, size), np.float32) for _ in range(2 * bool(size))]
        self._prediction = np.zeros_like(self.sample[0])
        self._correction: Correction | None = None
        self._known: Known | None = None
        self._read = np.zeros((streams, 0), np.float32)
        self.idle: IdleSteps | None = None
        if IDLE in manifest.pieces:
            self.idle = IdleSteps(sessions[IDLE], self._sampler, manifest.spec.sample, streams, shape)
        self._no_correction = no_correction(self._steps, manifest.spec.sample, view.groups)
        # By the correction's identity, which the entry keeps from reuse, and whether there is a prefix.
        self._advances: dict[tuple[int, bool], _Advances] = {}
        self._advance = self.advances_with(None)
        self._dense, self._blocks = dict[int, Bound](), list[BoundBlock]()
        if block_name(0) in sessions:
            self.bind_blocks()

    def start(
        self, obs: Mapping[str, FloatArray], noise: Noise, correction: Correction | None, known: Known | None = None
    ) -> None:
        """Take in what a call is given, and run what decides before the loop."""
        fill_initial(self._initial, noise, known)
        np.copyto(self.sample[0], self._initial.transpose(2, 0, 1))
        self._correction, self._known = correction, known
        self._advance = self.advances_with(correction, known)
        self._history.fill(0)
        if self._memory:
            self._memory[0].fill(0)
        fill_offset(self.offset, self._sampler, noise, correction)
        if obs:
            run_prologue(self._sessions, self._manifest.pieces, obs, self._contexts)
        self._read = np.zeros((self.streams, 0), np.float32)
        if correction is not None and correction.reads:
            self._read = correction.read(self.condition())
            self.offset += correction.from_condition(self._read)
        if known is not None:
            hold_known(self.offset, known)

    def condition(self) -> FloatArray:
        """What a correction reads of the observation, ``[B, N]``."""
        return np.asarray(self._contexts.features(), dtype=np.float32)

    def begin(self) -> None:
        """The residual stream of step 0; fills ``fresh``."""
        self._stem.run()

    def logits(self) -> FloatArray:
        """The pruner: float32 ``[B, K, blocks, 4]``. Reads condition values alone, so the loop may run meanwhile."""
        piece = self._manifest.pieces[PRUNER]
        feed = {name: self._contexts.values[name] for name in piece.inputs}
        made = run_named(self._sessions[PRUNER], piece.outputs, feed)
        return np.asarray(made[piece.outputs[0]], dtype=np.float32)

    def advance(self, k: int) -> None:
        """Tail, sampler, correction, and the next step's stem: reads ``hidden``, writes ``fresh`` and a sample."""
        self._advance.steps[k].run()
        if self._advance.anchors[k]:
            remember(self._history, self.sample[k % 2], self._prediction)
            self._jump_from(k, self._history)

    def enter_idle(self, k: int) -> None:
        """Hand the state of step k over to ``idle``."""
        assert self.idle is not None
        self.idle.enter(self.sample[k % 2], self._history, self._memory[k % 2] if self._memory else None)

    def run_idle(self, first: int, stop: int) -> None:
        """Steps that all add the total that ``idle`` has been prepared for."""
        assert self.idle is not None
        rows = self._advance.updates, self.offset, self._advance.anchors
        for anchor in self._advance.correction.jumps:
            if first <= anchor < stop:
                self.idle.run(first, anchor + 1, *rows)
                self._jump_from(anchor, self.idle.history)
                first = anchor + 1
        self.idle.run(first, stop, *rows)

    def _jump_from(self, anchor: int, history: FloatArray) -> None:
        """What is added where the run of steps after an anchor ends: known now, and so a part of that step's offset."""
        correction = self._advance.correction
        if anchor not in correction.jumps:
            return
        j, landing = correction.jumps[anchor]
        added = correction.jump(j, self._read, history)
        if self._known is not None:
            added[self._known.channels, :, self._known.positions] = 0
        self.offset[landing] += added

    def leave_idle(self, k: int) -> None:
        """Take the state of step k back from ``idle``, and make the residual stream as that step begins."""
        assert self.idle is not None
        self.idle.leave(self.sample[k % 2], self._history, self._memory[k % 2] if self._memory else None)
        if k < self._steps:
            np.copyto(self._initial, self.sample[k % 2].transpose(1, 2, 0))
            self._stem.run()

    def result(self) -> FloatArray:
        """The sample after the last step, a copy ``[B, T, D]``."""
        return self.sample[self._steps % 2].transpose(1, 2, 0).copy()

    def entry(self, cell: int) -> Array:
        """An entry of the rollout cache; a new one holds zeros."""
        if cell not in self.rollout:
            self.rollout[cell] = np.full(self.hidden.shape, 0.0, np.float32)  # which commits its pages now
        return self.rollout[cell]

    def bind_blocks(self) -> None:
        """Make what running a single block would have to make; ``sessions`` has those of single blocks."""
        names = map(block_name, range(len(self.current)))
        self._blocks = [
            BoundBlock(self._sessions[name], self._manifest.pieces[name], self._contexts, self.hidden, residual)
            for name, residual in zip(names, self.current, strict=True)
        ]

    def bind_dense(self, k: int) -> Bound:
        """What runs all blocks at step k; made once."""
        bound = self._dense.get(k)
        if bound is None:
            piece = self._manifest.pieces[DENSE_STEP]
            inputs = {CONTEXT + name: self._contexts.at(name, k) for name in piece.contexts} | {STREAM: self.fresh}
            outputs = dict(zip(piece.outputs, (self.hidden, *self.current), strict=True))
            bound = self._dense[k] = Bound(self._sessions[DENSE_STEP if k else FIRST_STEP], inputs, outputs)
        return bound

    def run_dense(self, k: int) -> None:
        """All blocks at step k for all streams: reads ``fresh``, writes ``hidden`` and ``current``."""
        self.bind_dense(k).run()

    def run(self, k: int, b: int) -> None:
        """Block b at step k for all streams: reads ``hidden``, writes ``current[b]``."""
        self._blocks[b].run(k)

    def take(self, whole: Workspace, streams: Sequence[int], cells: Iterable[int]) -> None:
        """Copy what these streams of a batch have after step 0, and their rollout cache for these cells."""
        self._contexts.take(whole._contexts, streams)
        self._correction, self._known, self._read = whole._correction, whole._known, whole._read[streams]
        self._advance = self.advances_with(self._correction, self._known)
        for own, theirs in zip(self._left_by_step_0(cells), whole._left_by_step_0(cells), strict=True):
            own[:] = theirs[streams]

    def give(self, whole: Workspace, streams: Sequence[int], cells: Iterable[int]) -> None:
        """Copy the sample of these streams, and their entries for these cells, back to the batch."""
        last = self._steps % 2
        np.moveaxis(whole.sample[last], 1, 0)[streams] = np.moveaxis(self.sample[last], 1, 0)
        for cell in cells:
            np.moveaxis(whole.entry(cell), self._axis, 0)[streams] = np.moveaxis(self.entry(cell), self._axis, 0)

    def _left_by_step_0(self, cells: Iterable[int]) -> list[Array]:
        """What the steps after step 0 go on from, with the streams first: views."""
        state = [(self.sample[1], 1), (self._history, 1), (self.offset, 2), *((each, 1) for each in self._memory[1:])]
        residuals = [(self.fresh, 0), (self.current, 1), *((self.entry(cell), 0) for cell in cells)]
        state += [(array, self._axis + before) for array, before in residuals]
        return [np.moveaxis(array, axis, 0) for array, axis in state]

    def sums(self, count: int) -> Array:
        """Room for sums, float32 ``[>= count, *hidden]``; what was in it is lost when it grows."""
        if len(self._sums) < count:
            self._sums = np.zeros((count, *self.hidden.shape), np.float32)
        return self._sums

    def advances_with(self, correction: Correction | None, known: Known | None = None) -> _Advances:
        """Bindings of all steps to the rows of a correction; made once for each, and once for its prefixes."""
        made = self._advances.get((id(correction), known is not None))
        if made is None:
            masked = None
            if known is not None:
                masked = MaskedUpdates(self.advances_with(correction).updates)
            used = correction or self._no_correction
            updates = matrices(self._sampler, used) if masked is None else masked.updates
            steps = [self._bind_advance(k, updates[k]) for k in range(self._steps)]
            made = _Advances(used, used.anchors.tolist(), updates, steps, masked)
            if len(self._advances) > KEPT_CORRECTIONS:  # who makes one for each call must not fill the memory
                del self._advances[next(iter(self._advances))]
            self._advances[id(correction), known is not None] = made
        if made.masked is not None and known is not None:
            made.masked.mask(known)
        return made

    def _bind_advance(self, k: int, update: Array) -> Bound:
        piece = self._manifest.pieces[ADVANCE]
        following = min(k + 1, self._steps - 1)  # after the last step no residual stream is made or read
        inputs = {
            STREAM: self.hidden,
            pieces.SAMPLE: self.sample[k % 2],
            pieces.OFFSET: self.offset[k],
            pieces.HISTORY: self._history,
            pieces.UPDATE: update,
            **{name: getattr(self._sampler, name)[k : k + 1] for name in pieces.X0_COLUMNS},
        }
        if self._memory:
            inputs[pieces.MEMORY] = self._memory[k % 2]
        for name in piece.inputs:
            if name not in inputs:
                where, _, context = name.partition(".")
                inputs[name] = self._contexts.at(context, k if where == pieces.TAIL else following)
        outputs = {
            pieces.SAMPLE_NEXT: self.sample[(k + 1) % 2],
            pieces.STREAM_NEXT: self.fresh,
            pieces.PREDICTION: self._prediction,
        }
        if self._memory:
            outputs[pieces.MEMORY_NEXT] = self._memory[(k + 1) % 2]
        return Bound(self._sessions[ADVANCE], {name: inputs[name] for name in piece.inputs}, outputs)


class BoundBlock:
    """A block bound to the residual stream that it reads and the residual that it writes, of all streams."""

    def __init__(
        self, session: Any, piece: PieceRecord, contexts: ContextValues, hidden: Array, residual: Array
    ) -> None:
        self._by_step: list[tuple[Array, Array]] = []  # where it is read from, and one value a step
        read: dict[str, Array] = {name: contexts.at(name, 0) for name in piece.contexts}
        for name in filter(contexts.is_stepwise, read):
            read[name] = read[name].copy()
            self._by_step.append((read[name], contexts.values[name]))
        assert piece.stream is not None
        self._bound = Bound(session, {piece.stream: hidden, **read}, {piece.outputs[0]: residual})

    def run(self, k: int) -> None:
        """Run at step k on the residual stream as it is."""
        for to, values in self._by_step:
            np.copyto(to, values[k])
        self._bound.run()


class _Advances(NamedTuple):
    """What ``advance`` runs with one correction."""

    correction: Correction
    anchors: list[bool]  # of each step, whether it enters the history
    updates: Array  # float32 [K, G, R, T]
    steps: list[Bound]
    masked: MaskedUpdates | None  # what the updates are of, with a prefix
