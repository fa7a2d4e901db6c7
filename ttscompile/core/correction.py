"""A linear correction of the sampler's steps, learned for one schedule.

A schedule that computes the network at a few steps and reuses residuals in between integrates the denoising equation
with an error that is mostly a *linear* function of what the loop already has: the sample, the prediction, and both of
them at the last two *anchors*, steps that compute much. So the sampler's scalar coefficients get company by matrices::

    features_k  = [sample_k, prediction_k, history_k]                               [B, 6 T, D]
    sample_k+1 += weights[k, d]^T features_k[:, :, d] + bias[k, d]                  for each action dimension d
    history     = [sample, prediction] of the last anchor, then of the one before   [B, 4 T, D], zeros at first

It mixes time steps of the chunk, never action dimensions, and costs ``12 T^2 D`` FLOPs a step: nothing beside a block.
The idea is that of solvers fitted to one model (Bespoke solvers, arXiv 2310.19075; DPM-Solver-v3, arXiv 2310.13268),
here fitted to one model *and* one schedule of reuse, by least squares, with the policy's own noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..errors import IllegalPlanError
from .spec import FloatArray

FEATURES = 6
"""Samples and predictions that the correction reads: of the step, and of the last two anchors."""

HISTORY = 4
"""Those of the anchors."""

LARGEST = 4 << 20
"""Numbers in the weights above which all action dimensions share them."""


@dataclass(frozen=True, eq=False)
class Correction:
    """The correction that belongs to one schedule.

    Attributes:
        anchors: bool ``[K]``; after these steps sample and prediction enter the history.
        weights: float32 ``[K, G, 6 T, T]``; G is the number of action dimensions, or 1 where they share.
        bias: float32 ``[K, G, 1, T]``.

    Raises:
        IllegalPlanError: shapes or dtypes that do not fit each other, or numbers that are not finite.
    """

    anchors: npt.NDArray[np.bool_]
    weights: npt.NDArray[np.float32]
    bias: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        steps, groups, _, horizon = self.weights.shape if self.weights.ndim == 4 else (0, 0, 0, 0)
        shapes = ((steps,), (steps, groups, FEATURES * horizon, horizon), (steps, groups, 1, horizon))
        arrays = (self.anchors, self.weights, self.bias)
        types = tuple(str(array.dtype) for array in arrays)
        if tuple(array.shape for array in arrays) != shapes or types != ("bool", "float32", "float32"):
            shown = ", ".join(f"{array.dtype}{list(array.shape)}" for array in arrays)
            raise IllegalPlanError(
                "a correction has anchors bool[K], weights float32[K, G, 6 T, T] and a bias float32[K, G, 1, T]; found"
                f" {shown}."
            )
        if not (np.isfinite(self.weights).all() and np.isfinite(self.bias).all()):
            raise IllegalPlanError("a correction holds numbers that are not finite. Calibrate the artifact again.")

    def require_fit(self, steps: int, sample: tuple[int, int]) -> None:
        """Raise unless it is a correction for a policy of K steps and samples ``(T, D)``.

        Raises:
            IllegalPlanError: it is not.
        """
        expected = (steps, groups_of(steps, sample), FEATURES * sample[0], sample[0])
        if self.weights.shape != expected:
            raise IllegalPlanError(
                f"the correction has weights {list(self.weights.shape)}; this policy needs {list(expected)}."
            )


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


def groups_of(steps: int, sample: tuple[int, int]) -> int:
    """Into how many groups the action dimensions of samples ``(T, D)`` fall: each for itself, or all in one."""
    horizon, dimensions = sample
    return dimensions if steps * dimensions * FEATURES * horizon * horizon <= LARGEST else 1


def no_correction(steps: int, sample: tuple[int, int]) -> Correction:
    """The correction of K steps and samples ``(T, D)`` that changes nothing."""
    groups, horizon = groups_of(steps, sample), sample[0]
    return Correction(
        anchors=np.zeros(steps, np.bool_),
        weights=np.zeros((steps, groups, FEATURES * horizon, horizon), np.float32),
        bias=np.zeros((steps, groups, 1, horizon), np.float32),
    )
