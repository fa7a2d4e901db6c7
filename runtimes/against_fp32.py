"""What another precision than fp32 does to the actions, and in which parts: calls in both, with equal noise."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.manifest import PrecisionError
from ttscompile.core.plan import DENSE, Plan
from ttscompile.core.spec import FP32, INT8, ChunkSpec, FloatArray, Noise
from ttscompile.errors import ObservationError

from .open import open_runtime
from .random_calls import normalized, random_calls
from .runtime import Runtime

CALLS = 8
"""Random observations that a precision is measured on. On Push-T at K = 100 that takes some seconds."""

FEW_CALLS = 3
"""Of these, those that single parts are measured on, and other noise: a dense call of a large policy takes seconds."""

SEED = 8
"""Of these observations and the noise."""

MARGIN = 4.0
"""Tolerance over the largest difference that was measured."""

SHARE = 0.1
"""Of what other noise changes: by so much at most the actions may change in what ``measure_parts`` chooses. Push-T in
int8: 0.03."""

Call = tuple[Mapping[str, FloatArray], Noise]
Pair = tuple[Runtime, Runtime]


@dataclass(frozen=True)
class Measured:
    """What a precision does to the actions.

    Attributes:
        kept: the parts that are in it.
        error: with all of these; None if there are none.
        alone: of each part that was measured, the mean of its difference where it alone is in the precision.
        other_noise: see ``PrecisionError``.
    """

    kept: tuple[str, ...]
    error: PrecisionError | None
    alone: Mapping[str, float]
    other_noise: float


def measure_precision(artifact: Artifact, runtimes: Pair | None = None) -> PrecisionError:
    """Dense calls in the artifact's precision against dense calls in fp32, on random observations, with equal noise.

    Observations are as ``ObservationSpec.draw`` makes them. Figures are rounded to four digits, so that they rarely
    depend on the processor.

    Args:
        artifact: with parts of another precision.
        runtimes: one in the precision in question and one in fp32; None for the artifact's in onnxruntime.
    """
    plans = [artifact.plan(f"{DENSE}@{name}") for name in (INT8, FP32)]
    own, exact = runtimes or [open_runtime(artifact, plan=plan) for plan in plans]
    against = _Exact.of(artifact, exact)
    return against.error(answers(own, plans[0], against.calls))


def measure_parts(artifact: Artifact, choose: bool = False) -> Measured:
    """What the precision of an artifact does to the actions, as a whole and part by part; see ``measure_precision``.

    One runtime is open at a time: each holds all weights.

    Args:
        artifact: with parts of another precision.
        choose: leave out parts, those with the largest difference first, until the mean difference is at most ``SHARE``
            of what other noise changes.
    """
    assert artifact.manifest.precision is not None
    exact = _Exact.of(artifact, open_runtime(artifact, plan=artifact.plans[DENSE]))

    def measured(parts: Collection[str], calls: int = CALLS) -> PrecisionError:
        plan = replace(artifact.plans[DENSE], precision=dict.fromkeys(parts, INT8))
        return exact.error(answers(open_runtime(artifact, plan=plan), plan, exact.calls[:calls]))

    kept = artifact.manifest.precision.kept
    error: PrecisionError | None = measured(kept)
    alone = {part: measured([part], FEW_CALLS).mean for part in kept} if len(kept) > 1 else {}
    while choose and error is not None and error.mean > SHARE * exact.other_noise:
        worst = max(kept, key=lambda part: alone.get(part, 0.0))
        alone.setdefault(worst, error.mean)
        kept = tuple(part for part in kept if part != worst)
        error = measured(kept) if kept else None
    return Measured(kept, error, alone, exact.other_noise)


@dataclass(frozen=True, eq=False)
class _Exact:
    """Dense calls in fp32.

    Attributes:
        chunk: of the policy.
        calls: normalised observations of one stream each, and noise.
        samples: what fp32 made of them, ``[T, D]`` each.
        other_noise: mean difference of the executed actions from those with other noise.
    """

    chunk: ChunkSpec
    calls: Sequence[Call]
    samples: Sequence[FloatArray]
    other_noise: float

    @classmethod
    def of(cls, artifact: Artifact, runtime: Runtime) -> _Exact:
        spec, plan = artifact.manifest.spec, artifact.plans[DENSE]
        calls: list[Call] = [(normalized(spec, obs), noise) for obs, noise in random_calls(spec, CALLS, SEED)]
        samples = answers(runtime, plan, calls)
        swapped = [(calls[i][0], calls[i + 1][1]) for i in range(FEW_CALLS)]
        apart = mean_errors(spec.chunk, answers(runtime, plan, swapped), samples[:FEW_CALLS])
        return cls(spec.chunk, calls, samples, _rounded(float(apart.mean())))

    def error(self, own: Sequence[FloatArray]) -> PrecisionError:
        """Of samples in another precision, those of the first calls.

        Raises:
            ObservationError: an action is not a number.
        """
        exact = self.samples[: len(own)]
        means = mean_errors(self.chunk, own, exact)
        pairs = list(zip(own, exact, strict=True))
        largest = max(action_errors(self.chunk, *pair).max() for pair in pairs)
        share = max(float(np.abs(one - other).max() / np.abs(other).max()) for one, other in pairs)
        return PrecisionError(
            calls=len(own),
            mean=_rounded(means.mean()),
            p90=_rounded(np.quantile(means, 0.9)),
            largest=_rounded(largest),
            tolerance=_rounded(MARGIN * share),
            other_noise=self.other_noise,
        )


def _rounded(number: float) -> float:
    return float(f"{number:.4g}")


def answers(runtime: Runtime, plan: Plan, calls: Iterable[Call]) -> list[FloatArray]:
    """Denoised samples ``[T, D]`` of calls that are an episode of one stream each.

    One stream, because the scale of activations is that of the whole batch.

    Args:
        runtime: that makes the calls.
        plan: without reads of earlier calls.
        calls: normalised observation and noise of one stream each.
    """
    samples = []
    for obs, noise in calls:
        runtime.reset()
        samples.append(runtime.predict(obs, noise, plan)[0][0])
    return samples


def mean_errors(chunk: ChunkSpec, own: Sequence[FloatArray], exact: Sequence[FloatArray]) -> npt.NDArray[np.float64]:
    """Mean ``action_errors`` of each call, of samples in the artifact's precision against those in fp32.

    Raises:
        ObservationError: an action is not a number.
    """
    for pair in zip(own, exact, strict=True):
        if not np.isfinite(pair).all():
            wrong, plain = (np.count_nonzero(~np.isfinite(sample)) for sample in pair)
            raise ObservationError(
                f"the policy's action is not a number: {plain} of its values in precision {FP32!r}, {wrong} in that of"
                f" the artifact. Convert with precision {FP32!r}; where it fails too, look for NaN in the checkpoint"
                " and in the recorded observations."
            )
    return np.array([action_errors(chunk, *pair).mean() for pair in zip(own, exact, strict=True)])


def action_errors(chunk: ChunkSpec, one: FloatArray, other: FloatArray) -> npt.NDArray[np.float64]:
    """Absolute differences of the executed actions of two samples ``[T, D]``, in the units of the actions, flat."""
    part = (slice(chunk.start, chunk.stop), slice(chunk.action_dim))
    difference = np.abs(one[part].astype(np.float64) - other[part])
    if chunk.normalizer is not None:
        difference /= np.abs(chunk.normalizer.scale)
    return difference.ravel()
