"""Values that the loop reads beside the stream, in the model of the whole call: made once, read by step."""

from __future__ import annotations

from collections.abc import Mapping

from onnx import ModelProto

from ..errors import LoweringError
from ..ir.graph import TensorType
from ..ir.pieces import CONDITION, STEP
from ..ir.program import Binding, Pieces, frame_values
from .graph_writer import GraphWriter, Weights


class Contexts:
    """Writes the prologue into the main graph; then hands out the value of a context at a step.

    Args:
        main: writer of the main graph.
        pieces: of the program.
        models: of ``condition`` and, if the program has them, ``frames``, frame pieces and ``step``.
        weights: values of their constants.
        observations: normalised, by name.
        streams: value of B, int64 ``[1]``.
        steps: K.
    """

    def __init__(
        self,
        main: GraphWriter,
        pieces: Pieces,
        models: Mapping[str, ModelProto],
        weights: Weights,
        observations: Mapping[str, str],
        streams: str,
        steps: int,
    ) -> None:
        self._main, self._pieces, self._streams, self._steps = main, pieces, streams, steps
        self._models, self._weights = models, weights
        self._sizes: dict[str, str] = {}
        condition = models[CONDITION]
        given = {**observations, **frame_values(pieces, self._inline, observations)}
        made = self._inline(CONDITION, given)
        self._conditions: dict[str, str] = dict(zip([v.name for v in condition.graph.output], made, strict=True))
        self._rows = {name: main.constant(table, table.dtype) for name, table in pieces.tables.items()}
        if pieces.step is not None:
            self._rows.update(self._step_values(models[STEP], weights))

    def _inline(self, name: str, values: Mapping[str, str]) -> list[str]:
        """The outputs of a piece on values by the name of its input."""
        model = self._models[name]
        return self._main.inline(model, {v.name: values[v.name] for v in model.graph.input}, self._weights)

    def condition(self) -> str:
        """What a correction reads: the pruner's features, one row of numbers a stream, ``[B, N]``."""
        types, rows = self._pieces.condition.types(), []
        for name in self._pieces.features:
            axis, value = types[name].batch_axis or 0, self._conditions[name]
            order = [axis, *(i for i in range(len(types[name].shape)) if i != axis)]
            rows.append(self._main.op("Flatten", self._main.op("Transpose", value, perm=order), axis=1))
        return rows[0] if len(rows) == 1 else self._main.op("Concat", *rows, axis=1)

    def value(self, w: GraphWriter, name: str, k: str, type_: TensorType) -> str:
        """A context at the step whose index is the value ``k``; ``w`` writes where it is read."""
        binding = self._pieces.bindings[name]
        if binding is Binding.CONDITION:
            return self._conditions[name]
        row = w.op("Gather", self._rows[name], k)
        return row if binding is Binding.STEP else self._repeated(w, row, name, type_, whole=False)

    def _step_values(self, model: ModelProto, weights: Weights) -> dict[str, str]:
        """Step values ``[K, ...]``, made for all steps in one batch of K * B, step-major."""
        step, main = self._pieces.step, self._main
        assert step is not None
        feeds = {}
        for name, type_ in step.inputs.items():
            axis = _batch_axis(name, type_)
            if self._pieces.bindings[name] is Binding.CONDITION:
                repeats = [self._steps if i == axis else 1 for i in range(len(type_.shape))]
                feeds[name] = main.op("Tile", self._conditions[name], main.constant(repeats))
                continue
            rows = self._repeated(main, self._rows[name], name, type_, whole=True)
            before, after = range(1, axis + 1), range(axis + 1, len(type_.shape) + 1)
            by_step = main.op("Transpose", rows, perm=[*before, 0, *after])
            feeds[name] = main.op("Reshape", by_step, main.constant([-1 if i == axis else n for i, n in _sizes(type_)]))
        made = main.inline(model, feeds, weights)
        types, found = step.types(), {}
        for name, value in zip([v.name for v in model.graph.output], made, strict=True):
            axis = _batch_axis(name, types[name])
            split = [part for i, n in _sizes(types[name]) for part in ([self._steps, -1] if i == axis else [n])]
            order = [axis, *(i for i in range(len(split)) if i != axis)]
            found[name] = main.op("Transpose", main.op("Reshape", value, main.constant(split)), perm=order)
        return found

    def _repeated(self, w: GraphWriter, rows: str, name: str, type_: TensorType, whole: bool) -> str:
        """A row of a table, or the whole of it, repeated to B streams."""
        if type_.batch_axis is None:
            return rows
        axis, key = _batch_axis(name, type_), f"{type_} {whole}"
        if key not in self._sizes:
            parts = [self._streams if i == axis else self._main.constant([n]) for i, n in _sizes(type_)]
            if whole:
                parts.insert(0, self._main.constant([self._steps]))
            self._sizes[key] = self._main.op("Concat", *parts, axis=0)
        return w.op("Expand", rows, self._sizes[key])


def _sizes(type_: TensorType) -> list[tuple[int, int]]:
    """Axes and their sizes for one stream."""
    return list(enumerate(type_.at(1)))


def _batch_axis(name: str, type_: TensorType) -> int:
    axis = type_.batch_axis
    if axis is None:
        what = f"context {name!r} : {type_} cannot be repeated for B streams: expected an axis of size B"
        raise LoweringError(f"{what}. Convert without the single file.")
    return axis
