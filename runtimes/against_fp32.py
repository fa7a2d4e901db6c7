"""What blocks of another precision than fp32 do to the actions: calls in both, with equal noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.manifest import DENSE, PrecisionError
from ttscompile.core.correction import Correction
from ttscompile.core.spec import FP32, ChunkSpec, FloatArray, Noise
from ttscompile.errors import ObservationError

from .open import open_runtime
from .random_calls import normalized, random_calls
from .runtime import Runtime

CALLS = 8
"""Random observations that a precision is measured on. On Push-T at K = 100 that takes some seconds."""

SEED = 8
"""Of these observations and the noise."""

MARGIN = 4.0
"""Tolerance over the largest difference that was measured."""

Call = tuple[Mapping[str, FloatArray], Noise]
Pair = tuple[Runtime, Runtime]


def measure_precision(artifact: Artifact, runtimes: Pair | None = None) -> PrecisionError:
    """Dense calls in the artifact's precision against dense calls in fp32, on random observations, with equal noise.

    Observations are as ``ObservationSpec.draw`` makes them. Figures are rounded to four digits, so that they rarely
    depend on the processor.

    Args:
        artifact: with blocks of another precision.
        runtimes: one in the precision in question and one in fp32; None for the artifact's in onnxruntime.
    """
    spec = artifact.manifest.spec
    calls = [(normalized(spec, obs), noise) for obs, noise in random_calls(spec, CALLS, SEED)]
    differences = compare(artifact, artifact.schedule(DENSE), calls, runtimes=runtimes)
    errors = np.array([action_errors(spec.chunk, one, other) for one, other in differences])
    shares = [float(np.abs(one - other).max() / np.abs(other).max()) for one, other in differences]
    p90 = np.quantile(errors.mean(axis=1), 0.9)
    return PrecisionError(CALLS, *(float(f"{n:.4g}") for n in (errors.mean(), p90, errors.max(), MARGIN * max(shares))))


def compare(
    artifact: Artifact,
    plan: npt.NDArray[np.int8],
    calls: Iterable[Call],
    correction: Correction | None = None,
    runtimes: Pair | None = None,
) -> list[tuple[FloatArray, FloatArray]]:
    """Denoised samples ``[T, D]`` of each call in the artifact's precision, and in fp32.

    Each call is an episode of one stream: the scale of activations is that of the whole batch.

    Args:
        artifact: with blocks of another precision.
        plan: ``[K, blocks]``, without reads of earlier calls.
        calls: normalised observation and noise of one stream each.
        correction: of the plan.
        runtimes: see ``measure_precision``.

    Raises:
        ObservationError: an action is not a number.
    """
    runtimes = runtimes or (open_runtime(artifact), open_runtime(artifact.at_precision(FP32)))
    pairs = []
    for obs, noise in calls:
        samples = []
        for runtime in runtimes:
            runtime.reset()
            samples.append(runtime.predict(obs, noise, plan, correction=correction)[0][0])
        if not np.isfinite(samples).all():
            own, exact = (np.count_nonzero(~np.isfinite(sample)) for sample in samples)
            raise ObservationError(
                f"the policy's action is not a number: {exact} of its values in precision {FP32!r}, {own} in that of"
                f" the artifact. Convert with precision {FP32!r}; where it fails too, look for NaN in the checkpoint"
                " and in the recorded observations."
            )
        pairs.append((samples[0], samples[1]))
    return pairs


def action_errors(chunk: ChunkSpec, one: FloatArray, other: FloatArray) -> npt.NDArray[np.float64]:
    """Absolute differences of the executed actions of two samples ``[T, D]``, in the units of the actions, flat."""
    part = (slice(chunk.start, chunk.stop), slice(chunk.action_dim))
    difference = np.abs(one[part].astype(np.float64) - other[part])
    if chunk.normalizer is not None:
        difference /= np.abs(chunk.normalizer.scale)
    return difference.ravel()
