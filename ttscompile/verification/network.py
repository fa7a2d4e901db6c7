"""The rungs of the network: what goes in and out of it, each block, and single evaluations; and what runs the pieces.

``Probe`` runs them one by one and step by step, with onnxruntime and numpy: what a runtime does in one go, to look
inside. It is slow and plain on purpose: where a call goes wrong and this goes right, the pieces are sound, and the
runtime that puts them together is not.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt

from ..artifact.golden import Golden, probe_stream, project
from ..artifact.load import Artifact
from ..artifact.manifest import Manifest
from ..artifact.view import View
from ..core.coercion import Array, Arrays
from ..core.correction import HISTORY, Correction, no_correction
from ..core.lattice import PlanArray, Source
from ..core.spec import FloatArray, Noise
from ..core.update import bounded, clip_of, matrices
from ..ir.pieces import ADVANCE, LAYERS, PREDICTION, STEM, STEP, STREAM, TAIL, advance_context, block_name
from ..runtimes.contexts import ContextValues
from ..runtimes.frames import FramePieces
from ..runtimes.onnxruntime.sessions import Sessions, run_named, run_piece, run_prologue
from .rung import ErrorMap, Rung, finite, judged


class Probe:
    """The pieces on one observation, normalised, ``[B, ...]`` by key."""

    def __init__(self, view: View, obs: Arrays) -> None:
        self._view, self._manifest, self._pool = view, view.manifest, Sessions(1)
        self._sessions = self._pool.of(view)
        self.streams = len(next(iter(obs.values())))
        pieces, arguments = self._manifest.pieces, self._manifest.spec.arguments
        named = self._manifest.spec.committed(self.streams)
        named |= {**obs, **{arguments[key]: value for key, value in obs.items()}}
        named |= FramePieces(pieces, partial(run_piece, self._sessions, pieces)).values(named)
        self._contexts = ContextValues(self._manifest, self.streams, np, np.zeros, view.tables)
        early = {name: piece for name, piece in pieces.items() if name != STEP}
        run_prologue(self._sessions, early, named, self._contexts)
        if (step := pieces.get(STEP)) is not None:
            for k in range(self._manifest.steps):  # a runtime has them in one batch
                feed = {name: self._contexts.at(name, k) for name in step.inputs}
                for name, value in run_named(self._sessions[STEP], step.outputs, feed).items():
                    self._contexts.values[name][k] = value
        self._tail_blanks = {
            one.name: np.zeros([n if isinstance(n, int) else self.streams for n in one.shape], np.float32)
            for one in self._sessions[ADVANCE].get_inputs()
        }

    def evaluate(self, sample: FloatArray, k: int) -> FloatArray:
        """The network's prediction at step k, ``[B, T, D]`` of ``[B, T, D]``."""
        hidden = self.stem(sample, k)
        for b in range(len(self._manifest.blocks)):
            hidden = hidden + self.block(b, k, hidden)
        return self.tail(hidden, k)

    def stem(self, sample: FloatArray, k: int) -> FloatArray:
        """The residual stream of step k."""
        return self._run(STEM, np.ascontiguousarray(sample), k)

    def block(self, b: int, k: int, hidden: FloatArray) -> FloatArray:
        """The residual of block b at step k."""
        return self._run(block_name(b), hidden, k)

    def layers(self, k: int, hidden: FloatArray) -> dict[str, FloatArray]:
        """What each layer of the one block gives at step k, by the layer's name, in the order of execution.

        Empty where the artifact has no such piece.
        """
        record = self._manifest.pieces.get(LAYERS)
        if record is None:
            return {}
        if LAYERS not in self._sessions:
            self._sessions |= self._pool.of_layers(self._view)
        feed = {name: hidden if name == record.stream else self._contexts.at(name, k) for name in record.inputs}
        return run_named(self._sessions[LAYERS], record.outputs, feed)

    def tail(self, hidden: FloatArray, k: int) -> FloatArray:
        """The prediction at step k, ``[B, T, D]``; what else ``advance`` computes is left aside."""
        feed = {**self._tail_blanks, STREAM: hidden}
        own = {name: advance_context(TAIL, name) for name in self._manifest.pieces[ADVANCE].contexts}
        feed |= {own[name]: self._contexts.at(name, k) for name in own if own[name] in feed}
        return run_named(self._sessions[ADVANCE], [PREDICTION], feed)[PREDICTION].transpose(1, 2, 0)

    def trace(self, noise: Noise, plan: PlanArray, correction: Correction | None) -> tuple[FloatArray, FloatArray]:
        """One call, the first of its episode, by the definitions in ``docs/design.md`` section 2.

        The plan is int8 ``[B, K, blocks]``, without ROLLOUT. Samples after every step, and predictions, are
        ``[K, B, T, D]``.
        """
        spec, blocks, groups = self._manifest.spec, self._manifest.blocks, self._manifest.groups
        sampler, horizon = spec.sampler, spec.sample[0]
        correction = correction or no_correction(sampler.steps, spec.sample)
        read = np.zeros((self.streams, 0), np.float32)
        if correction.reads:
            read = correction.read(self._contexts.features())
        updates, own, shared = matrices(sampler, correction), dict[int, Array](), dict[int, Array]()
        sample = noise.initial.transpose(2, 0, 1)
        dimensions = sample.shape[0]
        history = np.zeros((dimensions, self.streams, HISTORY * horizon), np.float32)
        memory = np.zeros((dimensions, self.streams, sampler.memories * horizon), np.float32)
        samples, predictions = [], []
        for k in range(sampler.steps):
            hidden = self.stem(sample.transpose(1, 2, 0), k)
            for b, block in enumerate(blocks):
                sources, axis, group = plan[:, k, b], block.type.batch_axis, groups[b]
                mask_shape = [1] * hidden.ndim
                if axis is not None:
                    mask_shape[axis] = self.streams
                computing, forwarding = (
                    (sources == source).reshape(mask_shape) if axis is not None else sources[0] == source
                    for source in (Source.COMPUTE, Source.FORWARD)
                )
                computed = self.block(b, k, hidden) if np.any(computing) else np.zeros_like(hidden)
                own_last, shared_last = own.get(b, computed), shared.get(group, computed)
                residual = np.where(computing, computed, np.where(forwarding, shared_last, own_last))
                own[b], shared[group] = (np.where(computing, computed, old) for old in (own_last, shared_last))
                hidden = hidden + residual
            prediction = self.tail(hidden, k).transpose(2, 0, 1)
            parts = [sample, prediction, history]
            if (clip := clip_of(sampler)) is not None:
                denoised = sampler.sample_to_x0[k] * sample + sampler.out_to_x0[k] * prediction
                parts.append(np.clip(denoised, -clip, clip))
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
        feed = {name: value if name == record.stream else self._contexts.at(name, k) for name in record.inputs}
        result: FloatArray = run_named(self._sessions[piece], record.outputs, feed)[record.outputs[0]]
        return result


PREPROCESSING, BLOCK, EVALUATION = "preprocessing", "block", "evaluation"

EXACT = 1e-5
"""Tolerance where both sides do the same few operations in float32, relative to the largest value."""

RESIDUAL = 5e-4
"""Tolerance of one residual, relative to its norm. Push-T: 1e-6; what processors and versions of onnxruntime differ in
is some 1e-5."""

OUTPUT = 1e-3
"""Tolerance of one evaluation, relative to its norm. Push-T: 2e-6."""

BlockFunction = Callable[[int, int, FloatArray], FloatArray]
"""Residual of block b at step k of a stream."""

CONVERT = "Convert the checkpoint again; if that does not help, please report it."


def relative(found: Array, expected: Array) -> float:
    """Size of the difference of two arrays as a share of the second's size."""
    difference = np.linalg.norm(found.astype(np.float64) - expected)
    size = float(np.linalg.norm(expected.astype(np.float64)))
    return float(difference) / max(size, 1e-30)


def largest(found: Array, expected: Array) -> float:
    """Largest difference as a share of the largest expected value; 0 for equal arrays, infinity for NaN."""
    difference = float(np.max(np.abs(found.astype(np.float64) - expected), initial=0.0))
    if not np.isfinite(difference):
        return float("inf")
    return difference / max(float(np.max(np.abs(expected.astype(np.float64)), initial=0.0)), 1e-30)


def check_preprocessing(artifact: Artifact, golden: Golden) -> Rung:
    """Normalisers, and which part of the sample is action: what stands around the network."""
    spec = artifact.manifest.spec
    errors: dict[str, float] = {}
    raw, network = golden.raw_observations(spec), golden.network_observations(spec)
    for key, one in spec.observations.items():
        errors[f"observation {key!r}"] = largest(one.normalized(raw[key]), network[key])
    errors["the action"] = largest(spec.chunk.unnormalized(golden.sample, spec.chunk.reference(raw)), golden.actions)
    errors["the executed part of the chunk"] = largest(spec.chunk.executed(golden.actions), golden.executed)
    wrong = [name for name, error in errors.items() if not error <= EXACT]
    observed = f"{len(raw)} observation{'s' * (len(raw) != 1)}"
    told = f"normalisers of {observed} and of the action, and the chunk, are the original's"
    if wrong:
        told = f"{', '.join(wrong)}: not what the original network was given, or what was made of its output. The"
        told += " normaliser or the chunk was changed or exchanged since the artifact was made."
    details = {"wrong": wrong, "errors": {name: finite(error) for name, error in errors.items()}}
    return judged(PREPROCESSING, max(errors.values()), EXACT, "of the largest", told, CONVERT, details=details)


def block_errors(
    manifest: Manifest, golden: Golden, function: BlockFunction, rows: npt.NDArray[np.int64] | None = None
) -> npt.NDArray[np.float64]:
    """Relative errors of each block taken alone, ``[A, blocks]``; of these rows of the recorded steps, None for all."""
    rows = np.arange(len(golden.steps)) if rows is None else rows
    norms = np.linalg.norm(golden.residuals.astype(np.float64), axis=(2, 3))
    errors = np.zeros((len(rows), len(manifest.blocks)))
    for b, block in enumerate(manifest.blocks):
        hidden = probe_stream(b, block.type, golden.streams, float(golden.scales[b]))
        # A block may give nothing at some step, or at all: then what counts is the residual stream that it is added to.
        floor = max(1e-3 * float(norms[:, b].max()), 1e-6 * float(np.linalg.norm(hidden)))
        for i, row in enumerate(rows.tolist()):
            found = project(function(b, int(golden.steps[row]), hidden), block.type.batch_axis)
            difference = float(np.linalg.norm(found.astype(np.float64) - golden.residuals[row, b]))
            errors[i, b] = difference / max(float(norms[row, b]), floor) if np.isfinite(difference) else np.inf
    return errors


def check_blocks(artifact: Artifact, golden: Golden, probe: Probe) -> tuple[Rung, ErrorMap]:
    """Each residual block alone, on a stream of its own, at every recorded step."""
    manifest = artifact.manifest
    errors = block_errors(manifest, golden, probe.block)
    kinds = tuple(block.kind for block in manifest.blocks)
    wrong, step, told = describe_blocks(errors, golden.steps, kinds)
    layer: str | None = None
    if wrong:
        layer, where = _first_layer(manifest, golden, probe)
        told += _shared_context(manifest, wrong) + where
    else:
        told = f"residuals of {len(kinds)} blocks at {len(golden.steps)} of {manifest.steps} steps are the original's"
    remedy = f"The weights or graphs of these blocks are not the checkpoint's. {CONVERT}"
    worst = float(errors.max())
    details = {"layer": layer}
    rung = judged(BLOCK, worst, RESIDUAL, "of the residual", told, remedy, step=step, blocks=wrong, details=details)
    return rung, ErrorMap(golden.steps, errors, RESIDUAL, kinds)


def describe_blocks(
    errors: npt.NDArray[np.float64], steps: npt.NDArray[np.int64], kinds: tuple[str, ...]
) -> tuple[tuple[int, ...], int | None, str]:
    """Which blocks differ, from which step on, and that in words; empty, None and nothing if none does."""
    above = ~(errors <= RESIDUAL)
    wrong = tuple(np.flatnonzero(above.any(0)).tolist())
    if not wrong:
        return (), None, ""
    step = int(steps[np.flatnonzero(above.any(1))[0]])
    shown = [f"{b} ({kinds[b]}) by {errors[:, b].max():.2g} at {int(above[:, b].sum())} steps" for b in wrong[:6]]
    more = f" and {len(wrong) - 6} more" if len(wrong) > 6 else ""
    plural = "s" * (len(wrong) > 1)
    return wrong, step, f"block{plural} {', '.join(shown)}{more} of {len(steps)}, first at step {step}"


def _first_layer(manifest: Manifest, golden: Golden, probe: Probe) -> tuple[str | None, str]:
    """The first layer inside the one block whose result differs, by name and in words; None where none can be named."""
    if golden.layers is None:
        return None, ""
    hidden = probe_stream(0, manifest.blocks[0].type, golden.streams, float(golden.scales[0]))
    for k, expected in zip(golden.evaluated.tolist(), golden.layers, strict=True):
        for (name, result), one in zip(probe.layers(k, hidden).items(), expected, strict=True):
            if not relative(project(result, None)[0], one) <= RESIDUAL:
                return name, f". Inside it {name!r} is the first layer that differs, at step {k}"
    shown = ", ".join(map(str, golden.evaluated.tolist()))
    return None, f". Each of its {golden.layers.shape[1]} layers is right at steps {shown}"


def _shared_context(manifest: Manifest, wrong: tuple[int, ...]) -> str:
    """What these blocks read and no other does, if there is such a value: then they need not be the culprits."""
    readers: dict[str, set[int]] = {}
    for b in range(len(manifest.blocks)):
        for context in manifest.pieces[block_name(b)].contexts:
            readers.setdefault(context, set()).add(b)
    shared = [name for name, blocks in readers.items() if len(blocks) > 1 and blocks == set(wrong)]
    return f". All of them read {shared[0]!r}, and nothing else does: look there first" if shared else ""


def check_evaluation(artifact: Artifact, golden: Golden, probe: Probe, blocks: Rung) -> Rung:
    """Whole evaluations of the network at a few steps, from the sample to the prediction."""
    steps: list[int] = golden.evaluated.tolist()
    errors = [
        relative(probe.evaluate(given, k), expected)
        for k, given, expected in zip(steps, golden.inputs, golden.outputs, strict=True)
    ]
    details = {"steps": steps, "errors": [finite(error) for error in errors]}
    worst, allowed = float(np.max(errors)), (OUTPUT, "of the output")
    wrong = [k for k, error in zip(steps, errors, strict=True) if not error <= OUTPUT]
    if not wrong:
        told = f"the network's output at steps {', '.join(map(str, steps))} is the original's"
        return judged(EVALUATION, worst, *allowed, told, "", details=details)
    cause = "what is not a block, since all blocks hold: stem, tail, or the encoder of the condition"
    if blocks.blocks:
        cause = f"its block{'s' * (len(blocks.blocks) > 1)} {', '.join(map(str, blocks.blocks))}"
    told = f"the network's output differs at steps {', '.join(map(str, wrong))}; the cause is {cause}"
    remedy = f"The artifact does not hold the checkpoint's network. {CONVERT}"
    return judged(EVALUATION, worst, *allowed, told, remedy, step=wrong[0], blocks=blocks.blocks, details=details)
