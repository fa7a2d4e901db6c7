"""What a call is given, as the loop takes it: the same for every device that computes with ``core.update``."""

from __future__ import annotations

import numpy as np

from ttscompile.core.correction import Correction
from ttscompile.core.spec import FloatArray, Noise, SamplerTable

from .inpainting import Known


def fill_initial(initial: FloatArray, noise: Noise, known: Known | None) -> None:
    """Write the sample at step 0, ``[B, T, D]``."""
    np.copyto(initial, noise.initial)
    if known is not None:
        initial[:, known.positions, known.channels] = known.values[0]


def fill_offset(offset: FloatArray, sampler: SamplerTable, noise: Noise, correction: Correction | None) -> None:
    """What every step adds to the sample that depends neither on it nor on the observation, ``[K, D, B, T]``."""
    if sampler.stochastic and noise.steps is not None:
        column = sampler.noise_to_next[:, None, None, None]
        np.multiply(noise.steps.transpose(0, 3, 1, 2), column, out=offset)
    else:
        offset.fill(0)
    if correction is not None:
        offset += correction.bias


def hold_known(offset: FloatArray, known: Known) -> None:
    """What a prefix makes known of the samples takes the place of what is added to them ``[K, D, B, T]``."""
    offset[:, known.channels, :, known.positions] = known.values[1:].transpose(0, 3, 1, 2)
