"""What the pieces read beside the stream, of one batch size, and the arrays that a block is bound to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ttscompile.artifact.manifest import ContextRecord, Manifest, PieceRecord
from ttscompile.core.spec import FloatArray
from ttscompile.errors import ArtifactError
from ttscompile.ir.pieces import CONDITION, STEP
from ttscompile.ir.program import Binding

from .sessions import Array, Bound, repeat_streams, run_named


class ContextValues:
    """Arrays that stay where they are, so that sessions can be bound to them.

    Attributes:
        values: by name; of the condition as they are, of steps and tables ``[K, ...]``.
    """

    def __init__(
        self, manifest: Manifest, sessions: Mapping[str, Any], tables: Mapping[str, Array], streams: int
    ) -> None:
        self._manifest, self._sessions, self.streams = manifest, sessions, streams
        self._step_inputs: dict[str, Array] = {}
        self.values: dict[str, Array] = {}
        for name, context in manifest.contexts.items():
            axis, steps = context.type.batch_axis, () if context.binding is Binding.CONDITION else (manifest.steps,)
            if context.binding is Binding.TABLE:  # its first axis is the step
                self.values[name] = repeat_streams(tables[name], None if axis is None else axis + 1, streams)
            else:
                self.values[name] = np.zeros((*steps, *context.type.at(streams)), context.type.dtype)

    def fill(self, obs: Mapping[str, FloatArray]) -> None:
        """The prologue: what the normalised observations ``[B, ...]`` decide."""
        piece = self._manifest.pieces[CONDITION]
        if piece.outputs:
            feed = {name: np.ascontiguousarray(obs[name]) for name in piece.inputs}
            for name, value in run_named(self._sessions[CONDITION], piece.outputs, feed).items():
                if name in self.values:  # a network that ignores the condition has values that nobody reads
                    np.copyto(self.values[name], value)
        if STEP in self._manifest.pieces:
            self._run_step(self._manifest.pieces[STEP])

    def condition(self) -> FloatArray:
        """What a correction reads: the features, one row of numbers a stream, ``[B, N]``."""
        rows = []
        for name in self._manifest.features:
            axis = self._manifest.contexts[name].type.batch_axis
            rows.append(np.moveaxis(self.values[name], axis or 0, 0).reshape(self.streams, -1))
        return np.concatenate(rows, axis=1)

    def at(self, name: str, k: int) -> Array:
        """The value of a context at step k."""
        value = self.values[name]
        if self._manifest.contexts[name].binding is Binding.CONDITION:
            return value
        row: Array = value[k, ...]  # an array still where it is one number
        return row

    def of(self, name: str) -> tuple[ContextRecord, Array]:
        """A context and its values: ``[K, ...]`` unless they are of the condition."""
        return self._manifest.contexts[name], self.values[name]

    def _run_step(self, piece: PieceRecord) -> None:
        """The step values of all steps in one batch of K * B, step-major."""
        feed, steps = {}, self._manifest.steps
        for name in piece.inputs:
            context = self._manifest.contexts[name]
            axis = context.type.batch_axis
            if context.binding is Binding.CONDITION:
                value = self.values[name]
                feed[name] = value if axis is None else np.concatenate([value] * steps, axis=axis)
                continue
            if name not in self._step_inputs:
                if axis is None:
                    problem = f"table {name!r} : {context.type} of the step piece has no axis for the streams"
                    raise ArtifactError(f"{problem}. Convert the checkpoint again.")
                self._step_inputs[name] = np.concatenate(list(self.values[name]), axis=axis)
            feed[name] = self._step_inputs[name]
        for name, value in run_named(self._sessions[STEP], piece.outputs, feed).items():
            axis = self._manifest.contexts[name].type.batch_axis
            if axis is None:
                raise ArtifactError(f"step value {name!r} has no axis for the streams. Convert the checkpoint again.")
            front = np.moveaxis(value, axis, 0)  # from [..., K * B, ...] to [K, ..., B, ...]
            split = front.reshape(steps, self.streams, *front.shape[1:])
            np.copyto(self.values[name], np.moveaxis(split, 1, axis + 1))


class BoundBlock:
    """A block bound to arrays for all streams, or for n of them."""

    def __init__(
        self,
        session: Any,
        piece: PieceRecord,
        contexts: ContextValues,
        axis: int,
        stream: Array,
        residual: Array,
        count: int,
    ) -> None:
        self._stream, self._axis = stream, axis
        self.rows = np.moveaxis(residual, axis, 0)
        whole = count == contexts.streams
        self._by_step: list[tuple[Array, Array]] = []  # where it is read from, and one value a step
        self._gathered: list[tuple[Array, Array, int, bool]] = []  # where, value, axis of the streams, one a step
        arrays: dict[str, Array] = {}
        for name in piece.contexts:
            context, value = contexts.of(name)
            batch, stepwise = context.type.batch_axis, context.binding is not Binding.CONDITION
            if not stepwise and (whole or batch is None):
                arrays[name] = value
                continue
            arrays[name] = np.zeros(context.type.at(count), context.type.dtype)
            if whole or batch is None:
                self._by_step.append((arrays[name], value))
            elif context.binding is Binding.TABLE:  # the same for every stream
                self._by_step.append((arrays[name], value.take(np.arange(count), axis=batch + 1)))
            else:
                self._gathered.append((arrays[name], value, batch, stepwise))
        inputs = {name: stream if name == piece.stream else arrays[name] for name in piece.inputs}
        self._bound = Bound(session, inputs, {piece.outputs[0]: residual})

    def run(self, k: int) -> None:
        """Run at step k on the stream as it is."""
        for to, values in self._by_step:
            np.copyto(to, values[k])
        self._bound.run()

    def gather(self, k: int, streams: Sequence[int], stream: Array) -> None:
        """Run at step k on these streams of the batch's ``stream``."""
        np.take(stream, streams, axis=self._axis, out=self._stream, mode="clip")
        for to, value, axis, stepwise in self._gathered:
            np.take(value[k] if stepwise else value, streams, axis=axis, out=to, mode="clip")
        self.run(k)
