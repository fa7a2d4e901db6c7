"""The rungs of the network: what goes in and out of it, each block, and single evaluations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from ..artifact.golden import Golden, probe_stream, project
from ..artifact.load import Artifact
from ..artifact.manifest import Manifest
from ..core.spec import FloatArray
from ..ir.pieces import block_name
from .probe import Probe
from .rung import ErrorMap, Rung, finite, judged

PREPROCESSING, BLOCK, EVALUATION = "preprocessing", "block", "evaluation"

EXACT = 1e-5
"""Tolerance where both sides do the same few operations in float32, relative to the largest value."""

RESIDUAL = 5e-4
"""Tolerance of one residual, relative to its norm. Push-T: 1e-6; what processors and versions of onnxruntime differ in
is some 1e-5."""

PREDICTION = 1e-3
"""Tolerance of one evaluation, relative to its norm. Push-T: 2e-6."""

BlockFunction = Callable[[int, int, FloatArray], FloatArray]
"""Residual of block b at step k of a stream."""

CONVERT = "Convert the checkpoint again; if that does not help, please report it."


def relative(found: npt.NDArray[Any], expected: npt.NDArray[Any]) -> float:
    """Size of the difference of two arrays as a share of the second's size."""
    difference = np.linalg.norm(found.astype(np.float64) - expected)
    size = float(np.linalg.norm(expected.astype(np.float64)))
    return float(difference) / max(size, 1e-30)


def largest(found: npt.NDArray[Any], expected: npt.NDArray[Any]) -> float:
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
    errors["the action"] = largest(spec.chunk.unnormalized(golden.sample), golden.actions)
    executed = golden.actions[:, spec.chunk.start : spec.chunk.stop]
    errors["the executed part of the chunk"] = largest(executed, golden.executed)
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
        stream = probe_stream(b, block.type, golden.streams, float(golden.scales[b]))
        # A block may give nothing at some step, or at all: then what counts is the stream that it is added to.
        floor = max(1e-3 * float(norms[:, b].max()), 1e-6 * float(np.linalg.norm(stream)))
        for i, row in enumerate(rows.tolist()):
            residual = function(b, int(golden.steps[row]), stream)
            found = project(residual, block.type.batch_axis)
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
    stream = probe_stream(0, manifest.blocks[0].type, golden.streams, float(golden.scales[0]))
    for k, expected in zip(golden.evaluated.tolist(), golden.layers, strict=True):
        found = probe.layers(k, stream)
        for (name, result), one in zip(found.items(), expected, strict=True):
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
    worst, allowed = float(np.max(errors)), (PREDICTION, "of the output")
    wrong = [k for k, error in zip(steps, errors, strict=True) if not error <= PREDICTION]
    if not wrong:
        told = f"the network's output at steps {', '.join(map(str, steps))} is the original's"
        return judged(EVALUATION, worst, *allowed, told, "", details=details)
    cause = "what is not a block, since all blocks hold: stem, tail, or the encoder of the condition"
    if blocks.blocks:
        cause = f"its block{'s' * (len(blocks.blocks) > 1)} {', '.join(map(str, blocks.blocks))}"
    told = f"the network's output differs at steps {', '.join(map(str, wrong))}; the cause is {cause}"
    remedy = f"The artifact does not hold the checkpoint's network. {CONVERT}"
    return judged(EVALUATION, worst, *allowed, told, remedy, step=wrong[0], blocks=blocks.blocks, details=details)
