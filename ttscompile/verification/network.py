"""The rungs of the network: what goes in and out of it, each block, and single evaluations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..artifact.golden import Golden, probe_stream, project
from ..artifact.load import Artifact
from ..artifact.manifest import Manifest
from ..core.spec import FloatArray
from ..ir.pieces import block_name
from .probe import Probe
from .rung import ErrorMap, Rung, finite, verdict

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

_CONVERT = "Convert the checkpoint again; if that does not help, please report it."


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
    worst = max(errors.values())
    if wrong:
        told = (
            f"{', '.join(wrong)}: not what the original network was given, or what was made of its output. The"
            " normaliser or the chunk was changed or exchanged since the artifact was made."
        )
    else:
        count = len(spec.observations)
        observed = f"{count} observation{'s' * (count != 1)}"
        told = f"normalisers of {observed} and of the action, and the chunk, are the original's"
    remedy = _CONVERT if wrong else ""
    details = {"wrong": wrong, "errors": {name: finite(error) for name, error in errors.items()}}
    return Rung(
        PREPROCESSING, verdict(not wrong), told, finite(worst), EXACT, "of the largest", remedy, details=details
    )


def block_errors(
    manifest: Manifest, golden: Golden, function: BlockFunction, rows: npt.NDArray[np.int64] | None = None
) -> npt.NDArray[np.float64]:
    """Relative errors of each block taken alone, ``[A, blocks]``.

    Args:
        manifest: manifest of the artifact.
        golden: its record.
        function: gives the residuals.
        rows: which of the recorded steps; None for all.
    """
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
    wrong, step, told = describe_blocks(errors, golden, kinds)
    if wrong:
        told += _shared_context(manifest, wrong)
    else:
        told = f"residuals of {len(kinds)} blocks at {len(golden.steps)} of {manifest.steps} steps are the original's"
    rung = Rung(
        BLOCK,
        verdict(not wrong),
        told,
        finite(float(errors.max())),
        RESIDUAL,
        "of the residual",
        f"The weights or graphs of these blocks are not the checkpoint's. {_CONVERT}" if wrong else "",
        step=step,
        blocks=wrong,
    )
    return rung, ErrorMap(golden.steps, errors, RESIDUAL, kinds)


def describe_blocks(
    errors: npt.NDArray[np.float64], golden: Golden, kinds: tuple[str, ...], rows: npt.NDArray[np.int64] | None = None
) -> tuple[tuple[int, ...], int | None, str]:
    """Which blocks differ, from which step on, and that in words; empty, None and nothing if none does."""
    steps = golden.steps if rows is None else golden.steps[rows]
    above = ~(errors <= RESIDUAL)
    wrong = tuple(np.flatnonzero(above.any(0)).tolist())
    if not wrong:
        return (), None, ""
    step = int(steps[np.flatnonzero(above.any(1))[0]])
    shown = [f"{b} ({kinds[b]}) by {errors[:, b].max():.2g} at {int(above[:, b].sum())} steps" for b in wrong[:6]]
    more = f" and {len(wrong) - 6} more" if len(wrong) > 6 else ""
    plural = "s" * (len(wrong) > 1)
    told = f"block{plural} {', '.join(shown)}{more} of {len(steps)}, first at step {step}"
    return wrong, step, told


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
    errors = []
    for k, given, expected in zip(golden.evaluated.tolist(), golden.inputs, golden.outputs, strict=True):
        errors.append(relative(probe.evaluate(given, k), expected))
    wrong = [int(k) for k, error in zip(golden.evaluated, errors, strict=True) if not error <= PREDICTION]
    worst = float(np.max(errors))
    steps = ", ".join(map(str, golden.evaluated.tolist()))
    told, remedy = f"the network's output at steps {steps} is the original's", ""
    if wrong:
        cause = (
            f"its block{'s' * (len(blocks.blocks) > 1)} {', '.join(map(str, blocks.blocks))}"
            if blocks.blocks
            else "what is not a block, since all blocks hold: stem, tail, or the encoder of the condition"
        )
        told = f"the network's output differs at steps {', '.join(map(str, wrong))}; the cause is {cause}"
        remedy = f"The artifact does not hold the checkpoint's network. {_CONVERT}"
    details: Mapping[str, Any] = {"steps": golden.evaluated.tolist(), "errors": [finite(error) for error in errors]}
    return Rung(
        EVALUATION,
        verdict(not wrong),
        told,
        finite(worst),
        PREDICTION,
        "of the output",
        remedy,
        step=wrong[0] if wrong else None,
        blocks=blocks.blocks if wrong else (),
        details=details,
    )
