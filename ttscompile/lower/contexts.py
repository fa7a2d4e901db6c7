"""Values that the loop reads beside the residual stream, in the model of the whole call: made once, read by step."""

from collections.abc import Mapping

import numpy as np
from onnx import ModelProto

from ..core.coercion import Arrays
from ..errors import LoweringError
from ..ir.graph import TensorType
from ..ir.pieces import PRUNER, STEP
from ..ir.program import Binding, Pieces, once_values
from .graph_writer import GraphWriter


class Contexts:
    """Writes the prologue of all streams into the main graph.

    Args:
        models: of ``condition`` and, if the program has them, ``frames``, frame pieces, ``step`` and ``pruner``.
        observations: normalised, by name.
        streams: value of B, int64 ``[1]``.
        steps: K.

    Attributes:
        rows: tables ``[K, ...]`` by name.
        by_step: step values ``[K * B, ...]`` by name, step-major, whatever their axis of streams is.
    """

    def __init__(
        self,
        main: GraphWriter,
        pieces: Pieces,
        models: Mapping[str, ModelProto],
        weights: Arrays,
        observations: Mapping[str, str],
        streams: str,
        steps: int,
    ) -> None:
        self._main, self._models, self._weights = main, models, weights
        self.pieces, self.streams, self.steps = pieces, streams, steps
        self.conditions = once_values(pieces, self._inline, observations)
        self.rows = {name: main.constant(table, table.dtype) for name, table in pieces.tables.items()}
        self.by_step = {} if pieces.step is None else self._step_values(models[STEP])

    def _inline(self, name: str, values: Mapping[str, str]) -> list[str]:
        model = self._models[name]
        return self._main.inline(model, {v.name: values[v.name] for v in model.graph.input}, self._weights)

    def logits(self, w: GraphWriter) -> str:
        """The pruner's, ``[B, K, N, 4]``; its constants have to be inputs of the whole model."""
        model, head = self._models[PRUNER], self.pieces.graphs()[PRUNER]
        reads = {value.name: self.conditions[value.name] for value in model.graph.input}
        return w.inline(model, {**reads, **{name: name for name in head.constants}}, {})[0]

    def condition(self) -> str:
        """What a correction reads: the pruner's features, one row of numbers a stream, ``[B, N]``."""
        types, rows = self.pieces.conditions, []
        for name in self.pieces.features:
            axis, value = types[name].batch_axis or 0, self.conditions[name]
            order = [axis, *(i for i in range(len(types[name].shape)) if i != axis)]
            rows.append(self._main.op("Flatten", self._main.op("Transpose", value, perm=order), axis=1))
        return rows[0] if len(rows) == 1 else self._main.op("Concat", *rows, axis=1)

    def _step_values(self, model: ModelProto) -> dict[str, str]:
        """Step values, made for all steps in one batch of K * B."""
        step, main = self.pieces.step, self._main
        assert step is not None
        feeds = {}
        for name, type_ in step.inputs.items():
            axis = _batch_axis(name, type_)
            if self.pieces.bindings[name] is Binding.CONDITION:
                repeats = [self.steps if i == axis else 1 for i in range(len(type_.shape))]
                feeds[name] = main.op("Tile", self.conditions[name], main.constant(repeats))
                continue
            sizes = _sizes(main, self.streams, type_, axis)
            whole = main.op("Expand", self.rows[name], main.op("Concat", main.constant([self.steps]), *sizes, axis=0))
            rank = len(type_.shape)
            by_step = main.op("Transpose", whole, perm=[*range(1, axis + 1), 0, *range(axis + 1, rank + 1)])
            shape = [-1 if i == axis else n for i, n in enumerate(type_.at(1))]
            feeds[name] = main.op("Reshape", by_step, main.constant(shape))
        made = main.inline(model, feeds, self._weights)
        types, found = step.types(), {}
        for name, value in zip([v.name for v in model.graph.output], made, strict=True):
            axis = _batch_axis(name, types[name])
            order = [axis, *(i for i in range(len(types[name].shape)) if i != axis)]
            found[name] = value if axis == 0 else main.op("Transpose", value, perm=order)
        return found


class StreamContexts:
    """Hands out the value of a context at a step, of the streams of these numbers, int64 ``[S]``.

    Its graph is inside of the main one; what does not change from step to step is written there.
    """

    def __init__(self, w: GraphWriter, contexts: Contexts, members: str) -> None:
        self._w, self._contexts, self._members = w, contexts, members
        self._streams = w.op("Shape", members)
        first = w.op("Mul", w.constant(np.arange(contexts.steps)[:, None]), contexts.streams)
        self._index = w.op("Add", first, members)  # [K, S], rows of ``by_step``
        self._sizes: dict[str, str] = {}
        self._conditions: dict[str, str] = {}

    def value(self, w: GraphWriter, name: str, k: str, type_: TensorType) -> str:
        """A context at the step whose index is the value ``k``; ``w`` writes where it is read."""
        binding = self._contexts.pieces.bindings[name]
        if binding is Binding.CONDITION:
            return self._condition(name, type_)
        if binding is Binding.STEP:
            rows = w.op("Gather", self._contexts.by_step[name], w.op("Gather", self._index, k))
            axis, rank = _batch_axis(name, type_), len(type_.shape)
            return rows if axis == 0 else w.op("Transpose", rows, perm=[*range(1, axis + 1), 0, *range(axis + 1, rank)])
        row = w.op("Gather", self._contexts.rows[name], k)
        if type_.batch_axis is None:
            return row
        if str(type_) not in self._sizes:
            sizes = _sizes(self._w, self._streams, type_, _batch_axis(name, type_))
            self._sizes[str(type_)] = self._w.op("Concat", *sizes, axis=0)
        return w.op("Expand", row, self._sizes[str(type_)])

    def _condition(self, name: str, type_: TensorType) -> str:
        value = self._contexts.conditions[name]
        if all(isinstance(n, int) for n in type_.shape):
            return value
        if name not in self._conditions:
            self._conditions[name] = self._w.op("Gather", value, self._members, axis=_batch_axis(name, type_))
        return self._conditions[name]


def _sizes(w: GraphWriter, streams: str, type_: TensorType, axis: int) -> list[str]:
    return [streams if i == axis else w.constant([n]) for i, n in enumerate(type_.at(1))]


def _batch_axis(name: str, type_: TensorType) -> int:
    axis = type_.batch_axis
    if axis is None:
        what = f"context {name!r} : {type_} cannot be repeated for B streams: expected an axis of size B"
        raise LoweringError(f"{what}. Convert without the single file.")
    return axis
