"""The pieces of an artifact one by one, with onnxruntime and numpy: what a runtime does in one go, to look inside.

Slow and plain on purpose, with a loop of its own that shares nothing with the runtimes': where a call goes wrong and
this goes right, the pieces are sound and the loop over them is not.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ..artifact.view import View
from ..core.correction import HISTORY, Correction, no_correction
from ..core.lattice import PlanArray, Source
from ..core.spec import FloatArray, Noise
from ..core.update import bounded, clips, matrices
from ..ir.pieces import ADVANCE, CONDITION, LAYERS, PREDICTION, STEM, STEP, STREAM, TAIL, advance_context, block_name
from ..ir.program import Binding
from ..runtimes.frames import FramePieces
from ..runtimes.onnxruntime.sessions import Sessions, repeat_streams, run_named, run_piece

Array = npt.NDArray[Any]


class Probe:
    """The pieces on one observation.

    Args:
        view: of an artifact.
        obs: normalised observations by key, ``[B, ...]``.
    """

    def __init__(self, view: View, obs: Mapping[str, Array]) -> None:
        self._view, self._manifest, self._pool = view, view.manifest, Sessions(1)
        self._sessions = self._pool.of(view)
        self.streams = len(next(iter(obs.values())))
        tables = {
            name: repeat_streams(view.tables[name], None if axis is None else axis + 1, self.streams)
            for name, context in view.manifest.contexts.items()
            if context.binding is Binding.TABLE
            for axis in (context.type.batch_axis,)
        }
        piece = self._manifest.pieces[CONDITION]
        arguments = self._manifest.spec.arguments
        named = {**obs, **{arguments[key]: value for key, value in obs.items()}}
        run = partial(run_piece, self._sessions, self._manifest.pieces)
        named |= FramePieces(self._manifest.pieces, run).values(named)
        feed = {name: np.ascontiguousarray(named[name]) for name in piece.inputs}
        condition = run_named(self._sessions[CONDITION], piece.outputs, feed) if piece.outputs else {}
        types = {name: view.manifest.contexts[name].type for name in view.manifest.features}
        rows = [np.moveaxis(condition[name], kind.batch_axis or 0, 0) for name, kind in types.items()]
        self._condition = [row.reshape(self.streams, -1) for row in rows]
        self._contexts = [self._step(k, tables, condition) for k in range(self._manifest.steps)]
        self._tail_blanks = {
            one.name: np.zeros([n if isinstance(n, int) else self.streams for n in one.shape], np.float32)
            for one in self._sessions[ADVANCE].get_inputs()
        }

    def evaluate(self, sample: FloatArray, k: int) -> FloatArray:
        """The network's prediction at step k, ``[B, T, D]`` of ``[B, T, D]``."""
        stream = self.stem(sample, k)
        for b in range(len(self._manifest.blocks)):
            stream = stream + self.block(b, k, stream)
        return self.tail(stream, k)

    def stem(self, sample: FloatArray, k: int) -> FloatArray:
        """The residual stream of step k."""
        return self._run(STEM, np.ascontiguousarray(sample), k)

    def block(self, b: int, k: int, stream: FloatArray) -> FloatArray:
        """The residual of block b at step k."""
        return self._run(block_name(b), stream, k)

    def layers(self, k: int, stream: FloatArray) -> dict[str, FloatArray]:
        """What each layer of the one block gives at step k, by the layer's name, in the order of execution.

        Empty where the artifact has no such piece.
        """
        record = self._manifest.pieces.get(LAYERS)
        if record is None:
            return {}
        if LAYERS not in self._sessions:
            self._sessions |= self._pool.of_layers(self._view)
        feed = {name: stream if name == record.stream else self._contexts[k][name] for name in record.inputs}
        return run_named(self._sessions[LAYERS], record.outputs, feed)

    def tail(self, stream: FloatArray, k: int) -> FloatArray:
        """The prediction at step k, ``[B, T, D]``; what else ``advance`` computes is left aside."""
        feed = {**self._tail_blanks, STREAM: stream}
        own = {name: advance_context(TAIL, name) for name in self._manifest.pieces[ADVANCE].contexts}
        feed |= {own[name]: self._contexts[k][name] for name in own if own[name] in feed}
        return run_named(self._sessions[ADVANCE], [PREDICTION], feed)[PREDICTION].transpose(1, 2, 0)

    def trace(self, noise: Noise, plan: PlanArray, correction: Correction | None) -> tuple[FloatArray, FloatArray]:
        """One call, the first of its episode, by the definitions in ``docs/design.md`` section 2.

        Args:
            noise: of the call.
            plan: int8 ``[B, K, blocks]``, without ROLLOUT.
            correction: of the plan.

        Returns:
            The sample after every step, and the prediction at every step, ``[K, B, T, D]`` each.
        """
        spec, blocks, groups = self._manifest.spec, self._manifest.blocks, self._manifest.groups
        sampler, horizon = spec.sampler, spec.sample[0]
        correction = correction or no_correction(sampler.steps, spec.sample)
        read = np.zeros((self.streams, 0), np.float32)
        if correction.reads:
            read = correction.read(np.concatenate(self._condition, 1))
        updates, own, shared = matrices(sampler, correction), dict[int, Array](), dict[int, Array]()
        sample = noise.initial.transpose(2, 0, 1)
        dimensions = sample.shape[0]
        history = np.zeros((dimensions, self.streams, HISTORY * horizon), np.float32)
        memory = np.zeros((dimensions, self.streams, sampler.memories * horizon), np.float32)
        samples, predictions = [], []
        for k in range(sampler.steps):
            stream = self.stem(sample.transpose(1, 2, 0), k)
            for b, block in enumerate(blocks):
                sources, axis, group = plan[:, k, b], block.type.batch_axis, groups[b]
                mask_shape = [1] * stream.ndim
                if axis is not None:
                    mask_shape[axis] = self.streams
                computing, forwarding = (
                    (sources == source).reshape(mask_shape) if axis is not None else sources[0] == source
                    for source in (Source.COMPUTE, Source.FORWARD)
                )
                computed = self.block(b, k, stream) if np.any(computing) else np.zeros_like(stream)
                own_last, shared_last = own.get(b, computed), shared.get(group, computed)
                residual = np.where(computing, computed, np.where(forwarding, shared_last, own_last))
                own[b], shared[group] = (np.where(computing, computed, old) for old in (own_last, shared_last))
                stream = stream + residual
            prediction = self.tail(stream, k).transpose(2, 0, 1)
            parts = [sample, prediction, history]
            if clips(sampler):
                assert sampler.clip is not None
                denoised = sampler.sample_to_x0[k] * sample + sampler.out_to_x0[k] * prediction
                parts.append(np.clip(denoised, -sampler.clip, sampler.clip))
            product = np.concatenate([*parts, memory], 2) @ updates[k]
            seen = np.einsum("bf,fdt->dbt", read, correction.observed[:, k])
            if k in correction.landings:
                seen = seen + correction.jump(correction.landings[k], read, history)
            following, memory = product[..., :horizon] + correction.bias[k] + seen, product[..., horizon:]
            if noise.steps is not None:
                following = following + sampler.noise_to_next[k] * noise.steps[k].transpose(2, 0, 1)
            if correction.anchors[k]:
                history = np.concatenate([sample, prediction, history[..., : history.shape[2] // 2]], 2)
            sample = np.asarray(following, np.float32)
            if k + 1 == sampler.steps:
                sample = bounded(sampler, sample)
            samples.append(sample.transpose(1, 2, 0))
            predictions.append(prediction.transpose(1, 2, 0))
        return np.stack(samples), np.stack(predictions)

    def _run(self, piece: str, value: FloatArray, k: int) -> FloatArray:
        record = self._manifest.pieces[piece]
        feed = {name: value if name == record.stream else self._contexts[k][name] for name in record.inputs}
        result: FloatArray = run_named(self._sessions[piece], record.outputs, feed)[record.outputs[0]]
        return result

    def _step(self, k: int, tables: Mapping[str, Array], condition: Mapping[str, Array]) -> dict[str, Array]:
        """What pieces read at step k beside the stream: rows of tables, condition values and step values, by name."""
        values = {**condition, **{name: table[k, ...] for name, table in tables.items()}}
        piece = self._manifest.pieces.get(STEP)
        if piece is not None:
            feed = {name: values[name] for name in piece.inputs}
            values |= run_named(self._sessions[STEP], piece.outputs, feed)
        return values
