"""One step of the sampler and its correction as one matrix product, beside what is not linear.

    denoised    = clip(sample_to_x0[k] * sample_k + out_to_x0[k] * prediction_k)          only where the sampler clips
    features_k  = [sample_k, prediction_k, history_k, denoised]                           [D, B, R]
    sample_k+1  = features_k @ matrices[k] + offsets[k]                                   [D, B, T]

R is ``7 T``, or ``6 T`` where nothing is clipped. The matrix is the correction's with the sampler's coefficients added
on diagonals; the offset is the noise that the step adds and the correction's bias, known before the loop. So the update
is three small operations in the place of a dozen. Everything has the action dimensions first: no operation has to turn
its arguments.
"""

from __future__ import annotations

import numpy as np

from .config import FloatArray, SamplerTable
from .correction import FEATURES, Correction


def clips(sampler: SamplerTable) -> bool:
    """Whether the update has a term that is not linear."""
    return sampler.clip is not None and bool((sampler.sample_to_x0 != 0).any() or (sampler.out_to_x0 != 0).any())


def rows(sampler: SamplerTable, horizon: int) -> int:
    """R."""
    return (FEATURES + clips(sampler)) * horizon


def diagonals(sampler: SamplerTable) -> dict[int, FloatArray]:
    """The sampler's coefficients ``[K]``, by the place in the features of what they multiply, in units of T."""
    if clips(sampler):
        return {0: sampler.sample_to_next, 1: sampler.out_to_next, FEATURES: sampler.x0_to_next}
    wide = {name: getattr(sampler, name).astype(np.float64) for name in sampler.COLUMNS}
    sample = wide["sample_to_next"] + wide["x0_to_next"] * wide["sample_to_x0"]
    out = wide["out_to_next"] + wide["x0_to_next"] * wide["out_to_x0"]
    return {0: sample.astype(np.float32), 1: out.astype(np.float32)}


def matrices(sampler: SamplerTable, correction: Correction) -> FloatArray:
    """The matrix of each step, float32 ``[K, G, R, T]``.

    Args:
        sampler: of the policy.
        correction: of the plan.
    """
    steps, groups, linear, horizon = correction.weights.shape
    result = np.zeros((steps, groups, rows(sampler, horizon), horizon), np.float32)
    result[:, :, :linear] = correction.weights
    each = np.arange(horizon)
    for place, column in diagonals(sampler).items():
        result[:, :, place * horizon + each, each] += column[:, None, None]
    return result
