"""The pieces of a policy for one call, in operations that a compiler or an exporter sees as they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace

import torch
from torch import Tensor

from ttscompile.ir.evaluate import Evaluator
from ttscompile.ir.graph import Graph
from ttscompile.ir.pieces import CONDITION, PRUNER, STEM, STEP, TAIL, block_name
from ttscompile.ir.program import Binding, Pieces, frame_values

from .idle_steps import IdleSteps

Tensors = Mapping[str, Tensor]


class PlainNetwork:
    """``loop.Network`` of one call; the prologue is computed when it is made.

    Args:
        pieces: of the artifact.
        evaluators: of all pieces, from ``evaluators_of``.
        weights: value of every constant.
        first: the same at step 0.
        tables: ``[K, ...]`` by name.
        obs: normalised, by key.
        streams: B.
        idle: see ``loop.Network``.

    Attributes:
        stream_type: of the residual stream.
    """

    def __init__(
        self,
        pieces: Pieces,
        evaluators: Mapping[str, Evaluator],
        weights: Tensors,
        first: Tensors,
        tables: Tensors,
        obs: Tensors,
        streams: int,
        idle: IdleSteps | None,
    ) -> None:
        self._pieces, self._evaluators, self._streams, self.idle = pieces, evaluators, streams, idle
        self._weights, self._first, self._tables = weights, first, tables
        self.stream_type = pieces.blocks[0].type
        seen = frame_values(pieces, lambda name, given: evaluators[name]({**weights, **given}), obs)
        made = evaluators[CONDITION]({**weights, **obs, **seen})
        self._condition = dict(zip(pieces.condition.outputs, made, strict=True))
        self._by_step: dict[int, dict[str, Tensor]] = {}  # step values, of steps that read them
        # Of every piece what it reads, and of every context the axis of streams: plain names, which a tracer follows.
        graphs = pieces.graphs()
        self._reads = {name: (*graph.inputs, *graph.constants) for name, graph in graphs.items()}
        self._axes = {name: kind.batch_axis for graph in graphs.values() for name, kind in graph.inputs.items()}
        self._blocks = tuple(map(block_name, range(len(pieces.blocks))))  # no text is made while something is traced
        self._streams_of = {name: piece.stream for name, piece in pieces.loop.items()}

    def of(self, members: Tensor) -> PlainNetwork:
        """The same for some of the streams."""
        other, types = copy(self), self._pieces.condition.types()
        other._streams, other._by_step = len(members), {}
        axes = {name: types[name].batch_axis for name in self._condition}
        other._condition = {
            name: value if (axis := axes[name]) is None else value.index_select(axis, members)
            for name, value in self._condition.items()
        }
        return other

    def apart(self) -> PlainNetwork:
        """The same with condition values that share no memory, which a loop of ``torch.export`` wants."""
        other, read = copy(self), {name for piece in self._pieces.graphs().values() for name in piece.inputs}
        other._condition = {n: value.clone() for n, value in self._condition.items() if n in read}
        return other

    def know_steps(self, steps: int) -> None:
        """Compute all step values: in a branch of ``torch.cond`` nothing can be kept."""
        if self._pieces.step is not None:
            for k in range(steps):
                self._step(k)

    def condition(self, features: Sequence[str]) -> Tensor:
        """What a correction reads, ``[B, N]``."""
        types = self._pieces.condition.types()
        rows = [self._condition[name].movedim(types[name].batch_axis or 0, 0) for name in features]
        return torch.cat([row.reshape(self._streams, -1) for row in rows], 1)

    def logits(self) -> Tensor:
        """The pruner's, ``[B, K, blocks, 4]``."""
        return self._run(PRUNER, {**self._weights, **self._condition})[0]

    def stem(self, sample: Tensor, k: int) -> Tensor:
        """See ``loop.Network``."""
        return self._at(k, STEM, sample)

    def block(self, b: int, k: int, stream: Tensor) -> Tensor:
        """See ``loop.Network``."""
        return self._at(k, self._blocks[b], stream)

    def tail(self, stream: Tensor, k: int) -> Tensor:
        """See ``loop.Network``."""
        return self._at(k, TAIL, stream)

    def contexts(self, k: Tensor) -> dict[str, Tensor]:
        """All that the pieces of the loop read at a step that only the program knows, int64 ``[1]``; by name."""
        rows = {name: self._repeated(name, table.index_select(0, k)[0]) for name, table in self._tables.items()}
        known = {**self._weights, **self._condition, **rows}
        return known if self._pieces.step is None else {**known, **self._step_values(known)}

    def run(self, name: str, value: Tensor, contexts: Tensors) -> Tensor:
        """A piece of the loop on a sample or a stream."""
        return self._run(name, {**contexts, self._streams_of[name]: value})[0]

    def _at(self, k: int, name: str, value: Tensor) -> Tensor:
        stream = self._streams_of[name]
        reads = {read: self._context(read, k) for read in self._reads[name] if read in self._axes and read != stream}
        return self._run(name, {**(self._weights if k else self._first), stream: value, **reads})[0]

    def _run(self, name: str, values: Tensors) -> tuple[Tensor, ...]:
        return self._evaluators[name].run([values[read] for read in self._reads[name]], self._streams)

    def _context(self, name: str, k: int) -> Tensor:
        binding = self._pieces.bindings[name]
        if binding is Binding.CONDITION:
            return self._condition[name]
        if binding is Binding.STEP:
            return self._step(k)[name]
        return self._repeated(name, self._tables[name][k])

    def _repeated(self, name: str, row: Tensor) -> Tensor:
        """A row of a table for all streams."""
        axis = self._axes[name]
        return row.expand([self._streams if i == axis else n for i, n in enumerate(row.shape)])

    def _step(self, k: int) -> dict[str, Tensor]:
        """The step values of step k."""
        step = self._pieces.step
        assert step is not None
        if k not in self._by_step:
            reads = {name: self._context(name, k) for name in step.inputs}
            self._by_step[k] = self._step_values({**self._weights, **reads})
        return self._by_step[k]

    def _step_values(self, reads: Tensors) -> dict[str, Tensor]:
        step = self._pieces.step
        assert step is not None
        return dict(zip(step.outputs, self._run(STEP, reads), strict=True))


def evaluators_of(pieces: Pieces) -> dict[str, Evaluator]:
    """Of every piece; constants are inputs, which an exporter puts others in the place of."""
    return {name: _of_values(graph) for name, graph in pieces.graphs().items()}


def _of_values(graph: Graph) -> Evaluator:
    return Evaluator(replace(graph, inputs={**graph.inputs, **graph.constants}, constants={}), {})
