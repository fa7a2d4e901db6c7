"""How far the observation of a call is from all that was recorded, and what a call does that is far outside.

What calibration learns, it learns from recorded episodes. It holds for a while outside of them, and then it fails worse
than reuse without any correction does. So an artifact says what was recorded, by principal components of what its own
encoder gives a correction, ``condition [B, N]``::

    distance = | condition @ reading - center |                                     [B], 1 for the furthest recorded one

In units of the deviation of each component that is Mahalanobis' distance, over the largest one that was recorded.
"""

from dataclasses import dataclass

import numpy as np

from ..errors import IllegalPlanError
from .coercion import Array
from .correction import Correction
from .lattice import PlanArray, uniform_plan
from .spec import FloatArray

FAR = 1.5
"""Times as far as the furthest recorded observation, from which on a call has no correction. ``docs/decisions.md``."""

ENVELOPE, CENTER, PLAIN = "envelope", "envelope_center", "plain_plan"
"""Inputs of a single ONNX file: of the envelope, and the cells of a call that is far outside."""


@dataclass(frozen=True, eq=False)
class Envelope:
    """Of what a calibration was given.

    Attributes:
        reading: float32 ``[N, E]``, from the condition's N numbers to E components.
        center: float32 ``[E]``, their mean.

    Raises:
        IllegalPlanError: other shapes or dtypes, or numbers that are not finite.
    """

    reading: FloatArray
    center: FloatArray

    def __post_init__(self) -> None:
        arrays = self.reading, self.center
        fits = self.reading.ndim == 2 and self.center.shape == self.reading.shape[1:]
        if not fits or any(array.dtype != np.float32 or not np.isfinite(array).all() for array in arrays):
            shown = ", ".join(f"{array.dtype}{list(array.shape)}" for array in arrays)
            expected = "an envelope has a reading float32 [N, E] and a center float32 [E], all finite"
            raise IllegalPlanError(f"{expected}; found {shown}. Calibrate the artifact again.")

    def distance(self, condition: FloatArray) -> FloatArray:
        """Of conditions ``[B, N]``, float32 ``[B]``; not above 1 for those that were recorded."""
        return np.asarray(np.linalg.norm(condition @ self.reading - self.center, axis=1), np.float32)

    def inputs(self, plain_cells: PlanArray) -> dict[str, Array]:
        """Of a single ONNX file, with the cells of a call that is far outside, int8 ``[K, blocks]``."""
        return {ENVELOPE: self.reading, CENTER: self.center, PLAIN: plain_cells}


def plain_cells(correction: Correction, blocks: int) -> PlanArray:
    """Of a call that is far outside, int8 ``[K, blocks]``: as many steps as a correction has anchors, evenly spaced."""
    return uniform_plan(len(correction.anchors), blocks, max(1, int(correction.anchors.sum())))
