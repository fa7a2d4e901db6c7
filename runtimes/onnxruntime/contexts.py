"""What the pieces read beside the stream, of one batch size: values of the condition, of each step, and of tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ttscompile.artifact.manifest import ContextRecord, Manifest, PieceRecord
from ttscompile.core.spec import FloatArray
from ttscompile.errors import ArtifactError
from ttscompile.ir.pieces import CONDITION, STEP
from ttscompile.ir.program import Binding

from .sessions import Array, repeat_streams, run_named


class ContextValues:
    """Arrays that stay where they are, so that sessions can be bound to them.

    Args:
        manifest: of the artifact.
        sessions: by piece.
        tables: TABLE contexts ``[K, ...]``.
        streams: B.

    Attributes:
        streams: B.
        values: by name; of the condition as they are, of steps and tables ``[K, ...]``.
    """

    def __init__(
        self, manifest: Manifest, sessions: Mapping[str, Any], tables: Mapping[str, Array], streams: int
    ) -> None:
        self._manifest, self._sessions, self.streams = manifest, sessions, streams
        self._step_inputs: dict[str, Array] = {}
        self.values: dict[str, Array] = {
            name: repeat_streams(tables[name], _row_axis(context), streams)
            if context.binding is Binding.TABLE
            else np.zeros(_shape(context, manifest.steps, streams), context.type.dtype)
            for name, context in manifest.contexts.items()
        }

    @property
    def nbytes(self) -> int:
        """Memory of the values."""
        return sum(array.nbytes for array in (*self.values.values(), *self._step_inputs.values()))

    def fill(self, obs: Mapping[str, FloatArray]) -> None:
        """The prologue: what the normalised observations ``[B, ...]`` decide."""
        piece = self._manifest.pieces[CONDITION]
        if piece.outputs:
            feed = {name: np.ascontiguousarray(obs[name]) for name in piece.inputs}
            for name, value in run_named(self._sessions[CONDITION], piece.outputs, feed).items():
                if name in self.values:
                    np.copyto(self.values[name], value)
                else:
                    self.values[name] = value  # a feature, which only the pruner reads
        if STEP in self._manifest.pieces:
            self._run_step(self._manifest.pieces[STEP])

    def at(self, name: str, k: int) -> Array:
        """The value of a context at step k."""
        value = self.values[name]
        if self._manifest.contexts[name].binding is Binding.CONDITION:
            return value
        row: Array = value[k, ...]  # an array still where it is one number
        return row

    def of_piece(self, piece: PieceRecord) -> dict[str, tuple[ContextRecord, Array]]:
        """Contexts that a piece of the loop reads, and their values: ``[K, ...]`` unless they are of the condition."""
        return {name: (self._manifest.contexts[name], self.values[name]) for name in piece.contexts}

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
                    raise ArtifactError(
                        f"table {name!r} : {context.type} of the step piece has no axis for the streams, so that the"
                        " steps cannot run as one batch. Convert the checkpoint again."
                    )
                self._step_inputs[name] = np.concatenate(list(self.values[name]), axis=axis)
            feed[name] = self._step_inputs[name]
        for name, value in run_named(self._sessions[STEP], piece.outputs, feed).items():
            np.copyto(self.values[name], self._by_step(name, value))

    def _by_step(self, name: str, value: Array) -> Array:
        """``[..., K * B, ...]`` as ``[K, ..., B, ...]``."""
        axis = self._manifest.contexts[name].type.batch_axis
        if axis is None:
            raise ArtifactError(f"step value {name!r} has no axis for the streams. Convert the checkpoint again.")
        front = np.moveaxis(value, axis, 0)
        split = front.reshape(self._manifest.steps, self.streams, *front.shape[1:])
        return np.moveaxis(split, 1, axis + 1)


def _row_axis(context: ContextRecord) -> int | None:
    """Batch axis of a whole table, whose first axis is the step."""
    axis = context.type.batch_axis
    return None if axis is None else axis + 1


def _shape(context: ContextRecord, steps: int, streams: int) -> tuple[int, ...]:
    one = context.type.at(streams)
    return one if context.binding is Binding.CONDITION else (steps, *one)
