"""Prefixes: actions that are committed before a call. The call keeps them, and inpaints the rest of its chunk.

Before every step, the sample at the positions of the prefix is the committed actions at the noise level of that step,
made with the call's own initial noise; after the last step it is the actions themselves::

    sample_k[:, start : start + N, :Da] = signal[k] * actions + deviation[k] * initial[:, start : start + N, :Da]
    sample_K[:, start : start + N, :Da] = actions

The other positions see them through the network. It is the replacement of RePaint (arXiv 2201.09865) without its
resampling, and with one draw of noise for all steps, so that a call stays a function of its arguments.

A policy that was trained to go on from a prefix (arXiv 2512.05964; ``PolicySpec.trained_prefix``) has the actions
themselves there before every step, with zeros in the channels that are no actions, and is told how many they are.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile.core.coercion import plain
from ttscompile.core.correction import groups_of
from ttscompile.core.spec import FloatArray, PolicySpec, SamplerTable
from ttscompile.core.values import check_numbers
from ttscompile.errors import ObservationError

TOLERANCE = 1e-3
"""Of the levels of a path that is one: tables are float32, and schedules round."""

Levels = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of the samples of a call.

    Attributes:
        positions: of the T time steps.
        channels: of the D dimensions.
        values: float32 ``[K + 1, B, N, channels]``, there, before each step and after the last. In calibration NaN
            where a call has fewer than N.
    """

    positions: slice
    channels: slice
    values: FloatArray


class MaskedUpdates:
    """The matrices of a correction with zeros for what is known, so that the offset alone decides there.

    One copy serves prefixes of every length: from call to call columns are put back, or made zeros.

    Args:
        updates: float32 ``[K, G, R, (1 + S) T]``, as they are without a prefix; G is 1 or D.

    Attributes:
        updates: the same for the prefix of the moment.
    """

    def __init__(self, updates: FloatArray) -> None:
        self.updates, self._plain = updates.copy(), updates
        self._length = 0

    def mask(self, known: Known) -> bool:
        """Set the prefix; whether it has another length than the one before."""
        start, length = known.positions.start, known.values.shape[2]
        if length == self._length:
            return False
        first, last = sorted((self._length, length))
        changed = (slice(None), known.channels, slice(None), slice(start + first, start + last))  # with G = 1, the one
        self.updates[changed] = 0 if length > self._length else self._plain[changed]
        self._length = length
        return True


def noise_levels(sampler: SamplerTable) -> Levels | None:
    """``signal`` and ``deviation``, float64 ``[K]``: a sample before step k is ``signal * clean + deviation * noise``.

    They follow from how the table predicts the clean sample: ``x0 = (x - sigma eps) / alpha`` or ``alpha x - sigma v``
    with ``alpha^2 + sigma^2 = 1``; or ``x0 = x + left v`` on a straight line from noise; each of them also as
    ``SamplerTable.with_skip`` writes it. A table that holds no clean sample (Runge-Kutta), or in whose network's output
    it cannot be told apart, has none.

    Returns:
        None if they do not follow.
    """
    levels = _levels(sampler)
    return levels if levels is not None else _levels(sampler.with_skip(-1))


def _levels(sampler: SamplerTable) -> Levels | None:
    sample, out = sampler.sample_to_x0.astype(np.float64), sampler.out_to_x0.astype(np.float64)
    if (sample > 0).all() and _keeps_variance(1 / sample, -out / sample):
        return 1 / sample, -out / sample
    if _keeps_variance(sample, -out):
        return sample, -out
    left = np.abs(out)
    straight = (sample == 1).all() and (out * out[0] > 0).all() and abs(left[0] - 1) <= TOLERANCE
    return (1 - left, left) if straight and _rises(1 - left) else None


def prefix_refusal(spec: PolicySpec) -> str | None:
    """Why a policy takes no prefix; None if it does."""
    if spec.chunk.switches:
        return "an action holds a number that has two values alone (a gripper's), and does not say which it came from."
    if spec.trained_prefix:
        return None  # whatever the table says, the sample holds the actions themselves, in all channels
    if noise_levels(spec.sampler) is None:
        return (
            f"the table of its sampler {spec.sampler.name!r} does not give the noise level of each step. Prefixes need"
            " a network that predicts noise or v (DDPM, DDIM, DPM-Solver++), or flow matching by Euler's method."
        )
    horizon, channels = spec.sample
    if spec.chunk.action_dim < channels and groups_of(spec.sampler.steps, (horizon, channels)) == 1:
        return (
            f"only {spec.chunk.action_dim} of the sample's {channels} channels are actions, and with {horizon} time"
            " steps all channels share the matrices of the sampler's steps, of which a prefix would take columns."
        )
    return None


def check_prefix(
    prefix: Any, streams: int, spec: PolicySpec, refusal: str | None, reference: FloatArray | None = None
) -> FloatArray:
    """A prefix as a float32 array ``[B, N, Da]`` that fits the policy, normalised: a copy of the caller's.

    ``reference`` is what the actions of the call are relative to, ``ChunkSpec.reference``.

    Raises:
        ObservationError: of another kind, dtype or shape, too long, not finite or too large; or the policy takes none.
    """
    array = plain(prefix, "prefix", ObservationError)
    room = spec.sample[0] - spec.chunk.start
    shape = (streams, array.shape[1] if array.ndim == 3 else 0, spec.chunk.action_dim)
    if array.shape != shape or array.dtype != np.float32:
        expected = f"float32 [B, N, Da] = [{streams}, N, {shape[2]}]; found {array.dtype} {list(array.shape)}"
        remedy = "Give the committed actions of every stream, from the chunk's first on."
        raise ObservationError(f"prefix must be {expected}. {remedy}")
    if shape[1] > room:
        rest = f"{room}, from its first executed one to the end of the prediction"
        raise ObservationError(f"prefix holds {shape[1]} actions; the chunk has {rest}. Give at most {room}.")
    if shape[1] > (spec.trained_prefix or room):
        told = f"prefix holds {shape[1]} actions; the policy was trained to go on from at most {spec.trained_prefix}"
        raise ObservationError(f"{told}. Give no more, or call earlier, so that fewer are executed meanwhile.")
    if shape[1] and refusal is not None:
        raise ObservationError(f"the policy takes no prefix: {refusal} Call it without one.")
    own, told = array.copy(), "prefix"
    if (relative := spec.chunk.relative) is not None:
        own, told = relative.absolute(own, reference, inverse=True), "prefix, less the observation,"
    remedy, normalizer = "Only actions that can be executed can be committed.", spec.chunk.normalizer
    rows = None if normalizer is None else normalizer.at(slice(spec.chunk.start, spec.chunk.start + shape[1]))
    check_numbers(own, rows, told, remedy, ObservationError)
    return spec.chunk.normalized(own, spec.chunk.start)


def known_samples(spec: PolicySpec, prefix: FloatArray, initial: FloatArray) -> Known | None:
    """What a prefix from ``check_prefix`` tells of samples that begin as ``initial [B, T, D]``; None if empty."""
    if not prefix.size:
        return None
    channels = slice(spec.chunk.action_dim)
    positions = slice(spec.chunk.start, spec.chunk.start + prefix.shape[1])
    if spec.trained_prefix:
        others = ((0, 0), (0, 0), (0, spec.sample[1] - spec.chunk.action_dim))
        clean = np.pad(prefix, others)
        return Known(positions, slice(None), np.stack([clean] * (spec.sampler.steps + 1)))
    levels = noise_levels(spec.sampler)
    assert levels is not None
    signal, deviation = (each.astype(np.float32)[:, None, None, None] for each in levels)
    noisy = signal * prefix + deviation * initial[:, positions, channels]
    return Known(positions, channels, np.concatenate([noisy, prefix[None]]))


def with_prefix(sample: FloatArray, known: Known | None) -> FloatArray:
    """A denoised sample ``[B, T, D]`` with the committed actions as they are, written into it."""
    if known is not None:
        sample[:, known.positions, known.channels] = known.values[-1]
    return sample


def _keeps_variance(signal: npt.NDArray[np.float64], deviation: npt.NDArray[np.float64]) -> bool:
    """Whether these are the levels of a process that adds noise and keeps the variance, seen backwards."""
    one = np.abs(signal**2 + deviation**2 - 1) <= TOLERANCE
    return bool(one.all() and (deviation > 0).all()) and _rises(signal)


def _rises(signal: npt.NDArray[np.float64]) -> bool:
    """Whether the signal grows from nothing or more; what falls is a table of something else."""
    return bool((signal >= -TOLERANCE).all() and (np.diff(signal) >= -TOLERANCE).all())
