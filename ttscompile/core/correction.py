"""A linear correction of the sampler's steps, learned for one schedule.

A schedule that computes the network at a few steps and reuses residuals in between integrates the denoising equation
with an error that is mostly a *linear* function of what the loop already has: the sample, the prediction, and both of
them at the last two *anchors*, steps that compute much. So the sampler's scalar coefficients get company by matrices::

    features_k  = [sample_k, prediction_k, history_k]                               [B, 6 T, D]
    sample_k+1 += weights[k, d]^T features_k[:, :, d] + bias[k, d]                  for each action dimension d
               += (condition @ reading) @ observed[:, k, d]
    history     = [sample, prediction] of the last anchor, then of the one before   [B, 4 T, D], zeros at first

It mixes time steps of the chunk, never action dimensions, and costs ``12 T^2 D`` FLOPs a step: nothing beside a block.
The second line reads the observation, as the policy's own encoder gives it to the pruner: ``condition [B, N]``. It
depends on nothing in the loop, so one product before the loop makes it for all steps.

Where enough was recorded, there are *jumps*, too: from an anchor to the next a small network says what the steps
between leave over (``docs/design.md``, section 2, has its formula). Anchors with no step between them have none.

The idea is that of solvers fitted to one model (Bespoke solvers, arXiv 2310.19075; DPM-Solver-v3, arXiv 2310.13268),
here fitted to one model *and* one schedule of reuse, by least squares, with the policy's own noise.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from ..errors import IllegalPlanError
from .coercion import Array, integer
from .spec import FloatArray

FEATURES = 6
"""Samples and predictions that the correction reads: of the step, and of the last two anchors."""

HISTORY = 4
"""Those of the anchors."""

CORRECTION, CORRECTION_BIAS, ANCHORS = "correction", "correction_bias", "correction_anchors"
READING, OBSERVED = "correction_reading", "correction_observed"
JUMPS, INNER, MIDDLE, OUTER = "correction_jumps", "correction_inner", "correction_middle", "correction_outer"
"""Inputs of a single ONNX file that carry a schedule's correction."""

LARGEST = 4 << 20
"""Numbers in the weights above which all action dimensions share them; and at most in what the observation adds."""

COMPONENTS = 64
"""Directions of the condition that the correction reads at most."""

MOST_NUMBERS = 16384
"""Of the condition, above which the correction does not read it: the keys of a prefix are millions."""

HIDDEN = 128
"""H, the width of a jump's hidden layers. On Push-T 256 is no better, and one layer is worse."""

MOST_OF_A_CHUNK = 1024
"""Numbers of a chunk, T times D, above which there are no jumps: they would read four times as many."""


def _no_jumps() -> FloatArray:
    return np.zeros((0, 0, 0), np.float32)


@dataclass(frozen=True, eq=False)
class Correction:
    """The correction that belongs to one schedule.

    Attributes:
        anchors: bool ``[K]``; after these steps sample and prediction enter the history.
        weights: float32 ``[K, G, 6 T, T]``; G is the number of action dimensions, or 1 where they share.
        bias: float32 ``[K, D, 1, T]``.
        reading: float32 ``[N, F]``; from the condition's N numbers to the F that are read. F is 0 where none are; N is
            what it is all the same where there are jumps, which a single ONNX file has read the condition itself.
        observed: float32 ``[F, K, D, T]``; what each of these adds to the sample of every step.
        inner: float32 ``[J, F + 4 T D + 1, H]``; J is the number of jumps, or 0 where there are none.
        middle: float32 ``[J, H + 1, H]``.
        outer: float32 ``[J, H + 1, T D]``.
        prefixes: actions of the longest prefix among the calls that it was fitted on; 0 where none had one.
        late: what a call with a prefix has in place of this, fitted on such calls; None for this.

    Raises:
        IllegalPlanError: shapes or dtypes that do not fit each other, or numbers that are not finite.
    """

    anchors: npt.NDArray[np.bool_]
    weights: FloatArray
    bias: FloatArray
    reading: FloatArray
    observed: FloatArray
    inner: FloatArray = field(default_factory=_no_jumps)
    middle: FloatArray = field(default_factory=_no_jumps)
    outer: FloatArray = field(default_factory=_no_jumps)
    prefixes: int = field(default=0, kw_only=True)
    late: "Correction | None" = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        steps, groups, _, horizon = self.weights.shape if self.weights.ndim == 4 else (0, 0, 0, 0)
        numbers, read = self.reading.shape if self.reading.ndim == 2 else (0, 0)
        dimensions = self.observed.shape[2] if self.observed.ndim == 4 else 0
        arrays = (self.anchors, self.weights, self.bias, self.reading, self.observed)
        expected = (
            ((steps,), "bool"),
            ((steps, groups, FEATURES * horizon, horizon), "float32"),
            ((steps, dimensions, 1, horizon), "float32"),
            ((numbers, read), "float32"),
            ((read, steps, dimensions, horizon), "float32"),
        )
        if tuple((array.shape, str(array.dtype)) for array in arrays) != expected:
            shown = ", ".join(f"{array.dtype}{list(array.shape)}" for array in arrays)
            raise IllegalPlanError(
                "a correction has anchors bool[K], and in float32 weights [K, G, 6 T, T], a bias [K, D, 1, T], a"
                f" reading [N, F] and what is observed [F, K, D, T]; found {shown}."
            )
        networks = (self.inner, self.middle, self.outer)
        chunk, count = horizon * dimensions, len(jumps_of(self.anchors))
        jumping = ((count, read + HISTORY * chunk + 1, HIDDEN), (count, HIDDEN + 1, HIDDEN), (count, HIDDEN + 1, chunk))
        shapes = tuple(array.shape for array in networks)
        known = shapes in (jumping, ((0, 0, 0),) * 3) and all(array.dtype == np.float32 for array in networks)
        if not known or (len(self.inner) and not may_jump((horizon, dimensions))):
            shown = ", ".join(f"{array.dtype}{list(array.shape)}" for array in networks)
            raise IllegalPlanError(
                f"between these anchors jumps have layers float32 {', '.join(map(str, jumping))}, or there are none;"
                f" there are none of a chunk of more than {MOST_OF_A_CHUNK} numbers; found {shown}."
            )
        if not all(np.isfinite(array).all() for array in (*arrays[1:], *networks)):
            raise IllegalPlanError("a correction holds numbers that are not finite. Calibrate the artifact again.")
        longest = integer(self.prefixes, "prefixes of a correction", IllegalPlanError, most=horizon)
        object.__setattr__(self, "prefixes", longest)

    def of(self, committed: int) -> "Correction":
        """The correction of a call with a prefix of so many actions."""
        return self if not committed or self.late is None else self.late

    @cached_property
    def jumps(self) -> dict[int, tuple[int, int]]:
        """By anchor, in order: the number of its jump, and the step after which that is added; empty without jumps."""
        return {anchor: (j, end) for j, (anchor, end) in enumerate(jumps_of(self.anchors).items()) if len(self.inner)}

    @cached_property
    def landings(self) -> dict[int, int]:
        """By the step after which a jump is added: the number of the jump."""
        return {end: j for j, end in self.jumps.values()}

    @property
    def flops_of_jumps(self) -> int:
        """For one stream. The FLOPs of all else are in the policy's record, whether there is a correction or not."""
        return len(self.jumps) * jump_flops((self.weights.shape[3], self.bias.shape[1]), self.reads)

    @property
    def reads(self) -> int:
        """F: how many numbers of the condition it reads; 0 if it does not read the observation."""
        return int(self.reading.shape[1])

    def require_fit(self, steps: int, sample: tuple[int, int], numbers: int, groups: int | None = None) -> None:
        """Raise IllegalPlanError unless it is for K steps, samples ``(T, D)`` and conditions of N numbers."""
        if self.late is not None:
            self.late.require_fit(steps, sample, numbers, groups)
        expected = (steps, groups or groups_of(steps, sample), FEATURES * sample[0], sample[0])
        if self.weights.shape != expected:
            raise IllegalPlanError(
                f"the correction has weights {list(self.weights.shape)}; this policy needs {list(expected)}."
            )
        found, wanted = (len(self.reading), self.observed.shape[2]), (numbers, sample[1])
        if self.reads > components_of(steps, sample, numbers) or ((self.reads or self.jumps) and found != wanted):
            raise IllegalPlanError(
                f"the correction reads {self.reads} combinations of {found[0]} numbers of the condition for"
                f" {found[1]} action dimensions; this policy has {numbers} such numbers and {sample[1]} dimensions."
            )

    def inputs(self) -> dict[str, Array]:
        """Its arrays by the names of the inputs of a single ONNX file (``lower.single_file``)."""
        named = {ANCHORS: self.anchors, CORRECTION: self.weights, CORRECTION_BIAS: self.bias}
        if self.reads:
            named |= {READING: self.reading, OBSERVED: self.observed}
        if self.jumps:
            which = np.full(len(self.anchors), -1, np.int64)
            which[list(self.landings)] = list(self.landings.values())
            # There the first layer reads the condition itself, so that no size is unknown but the number of jumps.
            inner = np.concatenate([self.reading @ self.inner[:, : self.reads], self.inner[:, self.reads :]], 1)
            named |= {JUMPS: which, INNER: inner, MIDDLE: self.middle, OUTER: self.outer}
        return named

    def read(self, condition: FloatArray) -> FloatArray:
        """What it reads of the condition ``[B, N]``: float32 ``[B, F]``."""
        return np.asarray(condition @ self.reading, np.float32)

    def from_condition(self, read: FloatArray) -> FloatArray:
        """What ``read [B, F]`` of the condition adds to the sample of every step, float32 ``[K, D, B, T]``."""
        count, *shape = self.observed.shape
        added = read @ self.observed.reshape(count, -1)
        return np.asarray(added, np.float32).reshape(-1, *shape).transpose(1, 2, 0, 3)

    def jump(self, j: int, read: FloatArray, history: FloatArray) -> FloatArray:
        """What jump number j adds to the sample, float32 ``[D, B, T]``.

        It is of ``read [B, F]`` of the condition, and of the history after the jump's anchor, ``[D, B, 4 T]``.
        """
        dimensions, streams, width = history.shape
        value = np.concatenate([read, history.transpose(1, 0, 2).reshape(streams, -1)], 1)
        for layer in (self.inner[j], self.middle[j]):
            value = np.maximum(value @ layer[:-1] + layer[-1], 0)
        added = value @ self.outer[j, :-1] + self.outer[j, -1]
        return np.asarray(added, np.float32).reshape(streams, dimensions, width // HISTORY).transpose(1, 0, 2)


def jumps_of(anchors: npt.NDArray[np.bool_]) -> dict[int, int]:
    """The last step before the next anchor, by the anchor; without anchors that the next one follows at once."""
    steps = np.flatnonzero(anchors).tolist()
    return {anchor: after - 1 for anchor, after in pairwise(steps) if after - 1 > anchor}


def may_jump(sample: tuple[int, int]) -> bool:
    """Whether a correction of samples ``(T, D)`` may have jumps."""
    return 0 < sample[0] * sample[1] <= MOST_OF_A_CHUNK


def jump_flops(sample: tuple[int, int], read: int) -> int:
    """FLOPs of one jump of one stream of samples ``(T, D)``, with F numbers that are read of the condition."""
    chunk = sample[0] * sample[1]
    return 2 * HIDDEN * (read + HISTORY * chunk + HIDDEN + chunk)


def remember(history: FloatArray, sample: FloatArray, prediction: FloatArray) -> None:
    """Enter sample and prediction of an anchor, ``[D, B, T]`` each, into the history ``[D, B, 4 T]``, in place."""
    horizon = sample.shape[2]
    history[:, :, 2 * horizon :] = history[:, :, : 2 * horizon]
    history[:, :, :horizon] = sample
    history[:, :, horizon : 2 * horizon] = prediction


def correction_flops(sample: tuple[int, int]) -> int:
    """FLOPs of one step of one stream of samples ``(T, D)``, multiply and add counted as two."""
    horizon, dimensions = sample
    return 2 * FEATURES * horizon * horizon * dimensions


def numbers_of(features: Iterable[tuple[int, ...]]) -> int:
    """N: how many numbers of the condition a correction may read; 0 where there are too many."""
    numbers = sum(math.prod(shape) for shape in features)
    return numbers if numbers <= MOST_NUMBERS else 0


def components_of(steps: int, sample: tuple[int, int], numbers: int) -> int:
    """How many numbers a correction reads at most of a condition of N numbers."""
    return min(COMPONENTS, numbers, LARGEST // (steps * sample[0] * sample[1]))


def condition_flops(steps: int, sample: tuple[int, int], numbers: int) -> int:
    """FLOPs of reading a condition of N numbers, once a call, for one stream of samples ``(T, D)``."""
    return 2 * components_of(steps, sample, numbers) * (numbers + steps * sample[0] * sample[1])


def groups_of(steps: int, sample: tuple[int, int]) -> int:
    """Into how many groups the action dimensions of samples ``(T, D)`` fall: each for itself, or all in one."""
    horizon, dimensions = sample
    return dimensions if steps * dimensions * FEATURES * horizon * horizon <= LARGEST else 1


def no_correction(steps: int, sample: tuple[int, int], groups: int | None = None) -> Correction:
    """The correction of K steps and samples ``(T, D)`` that changes nothing."""
    groups, (horizon, dimensions) = groups_of(steps, sample) if groups is None else groups, sample
    return Correction(
        anchors=np.zeros(steps, np.bool_),
        weights=np.zeros((steps, groups, FEATURES * horizon, horizon), np.float32),
        bias=np.zeros((steps, dimensions, 1, horizon), np.float32),
        reading=np.zeros((0, 0), np.float32),
        observed=np.zeros((0, steps, dimensions, horizon), np.float32),
    )
