"""One step of the sampler and its correction as one matrix product, beside what is not linear.

    denoised    = clip(sample_to_x0[k] * sample_k + out_to_x0[k] * prediction_k)          only where the sampler clips
    features_k  = [sample_k, prediction_k, history_k, denoised, memory_k]                 [D, B, R]
    product     = features_k @ matrices[k]                                                [D, B, (1 + S) T]
    sample_k+1  = product[:T] + offsets[k]                                                [D, B, T]
    memory_k+1  = product[T:]                                                             [D, B, S T]

R is ``(7 + S) T``, or ``(6 + S) T`` where nothing is clipped; S is the number of the sampler's memories, mostly 0. The
matrix is the correction's with the sampler's coefficients added on diagonals; the offset is the noise that the step
adds and the correction's bias, known before the loop. So the update is three small operations in the place of a dozen.
Everything has the action dimensions first: no operation has to turn its arguments. The correction reads and corrects
samples, never memories.

After the last step a corrected sample is clipped where the sampler has clipped it (``bounded``).
"""

import numpy as np

from .correction import FEATURES, Correction, correction_flops
from .spec import FloatArray, SamplerTable


def clip_of(sampler: SamplerTable) -> float | None:
    """The bound of denoised samples, for which the update has a term that is not linear; None where it has none."""
    predicts = (sampler.sample_to_x0 != 0).any() or (sampler.out_to_x0 != 0).any()
    return sampler.clip if predicts else None


def bounded(sampler: SamplerTable, sample: FloatArray) -> FloatArray:
    """A denoised sample, of any shape, with every number within what the sampler leaves it.

    A correction adds to what the sampler clipped, and so could leave that. One with infinite numbers stays as it is, so
    that whoever looks for them finds them.
    """
    if sampler.bound is None or not np.isfinite(sample).all():
        return sample
    return np.clip(sample, -sampler.bound, sampler.bound)


def rows(sampler: SamplerTable, horizon: int) -> int:
    """R."""
    return (FEATURES + (clip_of(sampler) is not None) + sampler.memories) * horizon


def columns(sampler: SamplerTable, horizon: int) -> int:
    """``(1 + S) T``."""
    return (1 + sampler.memories) * horizon


def update_flops(sampler: SamplerTable, sample: tuple[int, int]) -> int:
    """FLOPs of one update of one stream of samples ``(T, D)`` with its correction, counted as its."""
    memories = sampler.memories
    return correction_flops(sample) * (FEATURES + memories) * (1 + memories) // FEATURES


def diagonals(sampler: SamplerTable) -> dict[tuple[int, int], FloatArray]:
    """The sampler's coefficients ``[K]``, by the places of what they multiply and of what they add to, in units of T.

    The places of features are those of ``features_k``; the result at place 0 is the sample, at 1 + s a memory.
    """
    wide = {name: getattr(sampler, name).astype(np.float64) for name in sampler.COLUMNS}
    memories, clipped = sampler.memories, clip_of(sampler) is not None
    own = [wide["x0_to_next"], wide["sample_to_next"], wide["out_to_next"]]
    results = [np.concatenate([np.stack(own, 1), sampler.memory_to_next.astype(np.float64)], 1)]
    results += [sampler.to_memory[:, s].astype(np.float64) for s in range(memories)]
    found = {}
    for place, (x0, sample, out, *kept) in enumerate(map(np.transpose, results)):
        if clipped:
            found[FEATURES, place] = x0
        else:
            sample, out = sample + x0 * wide["sample_to_x0"], out + x0 * wide["out_to_x0"]
        found |= {(0, place): sample, (1, place): out}
        found |= {(FEATURES + clipped + s, place): column for s, column in enumerate(kept)}
    return {places: column.astype(np.float32) for places, column in found.items()}


def matrices(sampler: SamplerTable, correction: Correction) -> FloatArray:
    """The matrix of each step, float32 ``[K, G, R, (1 + S) T]``."""
    steps, groups, linear, horizon = correction.weights.shape
    result = np.zeros((steps, groups, rows(sampler, horizon), columns(sampler, horizon)), np.float32)
    result[:, :, :linear, :horizon] = correction.weights
    each = np.arange(horizon)
    for (read, written), column in diagonals(sampler).items():
        result[:, :, read * horizon + each, written * horizon + each] += column[:, None, None]
    return result
