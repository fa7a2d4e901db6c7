"""What an artifact may ask of this machine: an onnxruntime for its graphs, and memory in proportion to its files."""

import importlib.util
import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import ArtifactError
from ..ir.graph import TensorType
from ..ir.program import Binding
from ..measure.versions import release
from .manifest import Manifest, Requires
from .strict_json import REMEDY

FREE_BYTES = 2**30
MAX_RATIO = 64
"""Buffers of one stream may take so many times the bytes of the artifact's files, or ``FREE_BYTES``. Push-T: 0.3."""

_HISTORY = 16
"""Samples that a runtime keeps beside those of every step, and then some."""


def check_runtime(requires: Requires, directory: Path) -> None:
    """Raise ArtifactError if onnxruntime is there, and too old for the graphs of an artifact."""
    if importlib.util.find_spec("onnxruntime") is None:
        return  # the reference runtime does without; the onnxruntime runtime says that it is missing
    # From 1.31 on it reports its use to its makers, on threads of its own, for which the end of a forked child waits.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    found = str(onnxruntime.__version__)
    if release(found) < release(requires.onnxruntime):
        raise ArtifactError(
            f"{directory}: its graphs (opset {requires.opset}) need onnxruntime >= {requires.onnxruntime}; {found} is"
            f" installed. Run: pip install 'onnxruntime>={requires.onnxruntime}'."
        )


def check_size(manifest: Manifest, directory: Path) -> None:
    """Raise if the values that a manifest declares are out of proportion to its files: it may declare what it likes."""
    allowed = max(FREE_BYTES, MAX_RATIO * sum(record.bytes for record in manifest.files.values()))
    total = sum(_bytes(manifest))
    if total > allowed:
        raise ArtifactError(
            f"{directory}: expected a policy whose values take at most {allowed} bytes, {MAX_RATIO} times its"
            f" files; its manifest declares {total}. {REMEDY}"
        )


def _bytes(manifest: Manifest) -> Iterator[int]:
    """Sizes of what a runtime allocates for one stream, about; Python's integers do not overflow."""
    steps, (horizon, channels) = manifest.steps, manifest.spec.sample
    drawn = horizon + manifest.spec.left_out  # noise is drawn for the original's steps, too
    yield 4 * drawn * channels * (steps + _HISTORY)
    yield 4 * steps * channels * (_HISTORY * horizon) * horizon  # the sampler's update, a matrix a step and channel
    for spec in manifest.spec.observations.values():
        yield math.prod(spec.shape) * np.dtype(spec.dtype).itemsize
    for context in manifest.contexts.values():
        yield _nbytes(context.type) * (1 if context.binding is Binding.CONDITION else steps)
    for plan in manifest.plans.values():
        yield manifest.steps_of(plan.loop) * len(manifest.blocks)  # cells
    for block in manifest.blocks:
        yield 4 * _nbytes(block.type)
    for tokens in manifest.tokens.values():
        yield from map(_nbytes, tokens.kept.values())


def _nbytes(kind: TensorType) -> int:
    return math.prod(kind.at(1)) * np.dtype(kind.dtype).itemsize
