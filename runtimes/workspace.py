"""Memory of one batch size: every buffer that the denoising loop touches, and the sessions bound to them.

Residuals live in one array ``[K * blocks, *stream]``. A cell is computed at most once a call, and a ROLLOUT read is of
the cell's own entry, so the same array is the cache of this call and the rollout cache of the episode. Pages of it are
only committed when a cell is computed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ttscompile.artifact.manifest import ContextRecord, Manifest, PieceRecord, block_name
from ttscompile.config import FloatArray, Noise, SamplerTable
from ttscompile.errors import ArtifactError, ObservationError
from ttscompile.ir.program import Binding

from .onnxruntime_sessions import Array, Bound, repeat_streams, run_named

STEM, ADVANCE = "stem", "advance"


class Workspace:
    """Buffers and bindings for B streams.

    Sample and stream have two buffers each, taken in turn: step k reads those of ``k % 2``, and ``advance`` writes the
    others.

    Args:
        manifest: of the artifact.
        sessions: by piece.
        tables: TABLE contexts ``[K, ...]``.
        streams: B.

    Attributes:
        streams: B.
        axis: the axis of the streams in the residual stream.
        sample: two arrays ``[B, T, D]``.
        stream: two arrays of the stream's type.
        residuals: float32 ``[K * blocks, *stream]``.
        table: float32 ``[blocks, *stream]``, what each reused block adds at the moment.
    """

    def __init__(
        self, manifest: Manifest, sessions: Mapping[str, Any], tables: Mapping[str, Array], streams: int
    ) -> None:
        kind = manifest.blocks[0].type
        shape = kind.at(streams)
        if any(block.type != kind for block in manifest.blocks) or kind.dtype != "float32":
            types = sorted({str(block.type) for block in manifest.blocks})
            raise ArtifactError(
                f"the residual stream changes its type, or is not float32: {types}. It cannot be executed."
            )
        if kind.batch_axis is None and streams > 1:
            raise ObservationError(
                f"this policy's residual stream has type {kind}, without an axis for the streams; found {streams}"
                " streams. Call it with one stream at a time."
            )
        self.streams = streams
        self.axis = kind.batch_axis or 0
        self._manifest, self._sessions = manifest, sessions
        self._steps, self._count = manifest.steps, len(manifest.blocks)
        self.sample = [np.zeros((streams, *manifest.spec.sample), np.float32) for _ in range(2)]
        self.stream = [np.zeros(shape, np.float32) for _ in range(2)]
        self.residuals = np.empty((self._steps * self._count, *shape), np.float32)
        self.table = np.empty((self._count, *shape), np.float32)
        self._noise = np.zeros((self._steps, streams, *manifest.spec.sample), np.float32)
        sampler = manifest.spec.sampler
        self._coefficients = np.stack([getattr(sampler, name) for name in SamplerTable.COLUMNS], axis=1)
        self._tables = {
            name: repeat_streams(table, _row_axis(manifest.contexts[name]), streams) for name, table in tables.items()
        }
        self._values: dict[str, Array] = {}  # condition values, and step values [K, ...]
        self._step_inputs: dict[str, Array] = {}
        self._blocks: dict[int, Bound] = {}
        self._advances: list[Bound] = []
        self._stem: Bound | None = None

    def start(self, obs: Mapping[str, FloatArray], noise: Noise) -> None:
        """Take in an observation and the noise of a call: everything up to the first residual stream."""
        np.copyto(self.sample[0], noise.initial)
        if self._manifest.spec.sampler.stochastic and noise.steps is not None:
            np.copyto(self._noise, noise.steps)
        piece = self._manifest.pieces["condition"]
        if piece.outputs:
            feed = {name: np.ascontiguousarray(obs[name]) for name in piece.inputs}
            self._keep(run_named(self._sessions["condition"], piece.outputs, feed))
        if "step" in self._manifest.pieces:
            self._run_step(self._manifest.pieces["step"])

    def begin(self) -> None:
        """The residual stream of step 0; fills ``stream[0]``."""
        if self._stem is None:
            piece = self._manifest.pieces[STEM]
            assert piece.stream is not None
            inputs = {piece.stream: self.sample[0], **self._contexts(piece, 0)}
            self._stem = Bound(self._sessions[STEM], inputs, {piece.outputs[0]: self.stream[0]})
        self._stem.run()

    def logits(self) -> FloatArray:
        """The pruner: float32 ``[B, K, blocks, 4]``."""
        piece = self._manifest.pieces["pruner"]
        feed = {name: self._values[name] for name in piece.inputs}
        logits = run_named(self._sessions["pruner"], piece.outputs, feed)[piece.outputs[0]]
        return np.asarray(logits, dtype=np.float32)

    def block(self, k: int, b: int) -> Bound:
        """Block b at step k for all streams: reads ``stream[k % 2]``, writes its row of ``residuals``."""
        cell = k * self._count + b
        bound = self._blocks.get(cell)
        if bound is None:
            name = block_name(b)
            piece = self._manifest.pieces[name]
            assert piece.stream is not None
            inputs = {piece.stream: self.stream[k % 2], **self._contexts(piece, k)}
            bound = Bound(self._sessions[name], inputs, {piece.outputs[0]: self.residuals[cell]})
            self._blocks[cell] = bound
        return bound

    def run_some(self, k: int, b: int, streams: Sequence[int]) -> None:
        """Block b at step k for these streams only; the other streams' residuals stay as they are."""
        name = block_name(b)
        piece = self._manifest.pieces[name]
        assert piece.stream is not None
        inputs = {piece.stream: np.take(self.stream[k % 2], streams, axis=self.axis)}
        for context, value in self._contexts(piece, k).items():
            axis = self._manifest.contexts[context].type.batch_axis
            inputs[context] = value if axis is None else np.take(value, streams, axis=axis)
        residual = run_named(self._sessions[name], piece.outputs, inputs)[piece.outputs[0]]
        row = self.residuals[k * self._count + b]
        np.moveaxis(row, self.axis, 0)[list(streams)] = np.moveaxis(residual, self.axis, 0)

    def advances(self) -> list[Bound]:
        """For each step: tail, sampler and the next step's stem; writes the other buffers of sample and stream."""
        if not self._advances:
            self._advances = [self._advance(k) for k in range(self._steps)]
        return self._advances

    def _advance(self, k: int) -> Bound:
        piece = self._manifest.pieces[ADVANCE]
        now, then = k % 2, (k + 1) % 2
        following = min(
            k + 1, self._steps - 1
        )  # after the last step there is no stream to make; its result is not read
        inputs = {
            "stream": self.stream[now],
            "sample": self.sample[now],
            "noise": self._noise[k],
            "coefficients": self._coefficients[k],
        }
        for name in piece.inputs:
            if name not in inputs:
                where, _, context = name.partition(".")
                inputs[name] = self._value(context, k if where == "tail" else following)
        outputs = {"sample_next": self.sample[then], "stream_next": self.stream[then]}
        return Bound(self._sessions[ADVANCE], {name: inputs[name] for name in piece.inputs}, outputs)

    def _contexts(self, piece: PieceRecord, k: int) -> dict[str, Array]:
        return {name: self._value(name, k) for name in piece.inputs if name != piece.stream}

    def _value(self, name: str, k: int) -> Array:
        """The value of a context at step k; an address that stays the same from call to call."""
        binding = self._manifest.contexts[name].binding
        if binding is Binding.CONDITION:
            return self._values[name]
        rows = self._tables if binding is Binding.TABLE else self._values
        row: Array = rows[name][k]
        return row

    def _keep(self, values: Mapping[str, Array]) -> None:
        """Copy values to where the bindings expect them."""
        for name, value in values.items():
            if name in self._values:
                np.copyto(self._values[name], value)
            else:
                self._values[name] = np.ascontiguousarray(value).copy()

    def _run_step(self, piece: PieceRecord) -> None:
        """The step values of all steps in one batch of K * B, step-major."""
        feed = {}
        for name in piece.inputs:
            context = self._manifest.contexts[name]
            axis = context.type.batch_axis
            if context.binding is Binding.CONDITION:
                value = self._values[name]
                feed[name] = value if axis is None else np.concatenate([value] * self._steps, axis=axis)
                continue
            if name not in self._step_inputs:
                if axis is None:
                    raise ArtifactError(
                        f"table {name!r} : {context.type} of the step piece has no axis for the streams, so that the"
                        " steps cannot run as one batch. Convert the checkpoint again."
                    )
                self._step_inputs[name] = np.concatenate(list(self._tables[name]), axis=axis)
            feed[name] = self._step_inputs[name]
        results = run_named(self._sessions["step"], piece.outputs, feed)
        self._keep({name: self._by_step(name, value) for name, value in results.items()})

    def _by_step(self, name: str, value: Array) -> Array:
        """``[..., K * B, ...]`` as ``[K, ..., B, ...]``."""
        axis = self._manifest.contexts[name].type.batch_axis
        if axis is None:
            raise ArtifactError(f"step value {name!r} has no axis for the streams. Convert the checkpoint again.")
        front = np.moveaxis(value, axis, 0)
        split = front.reshape(self._steps, self.streams, *front.shape[1:])
        return np.moveaxis(split, 1, axis + 1)


def _row_axis(context: ContextRecord) -> int | None:
    """Batch axis of a whole table, whose first axis is the step."""
    axis = context.type.batch_axis
    return None if axis is None else axis + 1
