"""Plans that are decided during the call: a criterion looks at each step and says which blocks are worth computing.

A criterion is a few numbers, which the record of a calibration holds as JSON. Calibration asks it once a step, between
two parts of the blocks; the runtimes execute one plan that it has decided::

    stem -> blocks 0..always-1, computed -> decide(k, feature) -> the other blocks, all computed or all reused -> tail

The feature is what the first ``always`` blocks add together, or the stream after the stem if there are none. What is
reused is the block's own last residual, so a decided plan is an ordinary plan of COMPUTE and TIMESTEP: it can be
reported, counted and replayed.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lattice import BoolArray, PlanArray, Source
from ...errors import ArtifactError, IllegalPlanError

_TINY = 1e-12
"""A feature smaller than this, on average, has no relative change worth dividing for."""


@dataclass(frozen=True)
class Criterion:
    """When the blocks after the first ones are computed again.

    Attributes:
        name: of the strategy that it comes from.
        always: how many blocks, from the first, are computed at every step; what they add together is the feature. 0:
            the feature is the residual stream after the stem.
        threshold: the blocks are computed where the estimated change is not below this.
        polynomial: from the relative change of the feature to the estimate, highest power first; ``(1, 0)`` leaves it
            as it is. Estimates below 0 count as 0.
        accumulates: add up the estimates from step to step until they reach the threshold; otherwise compare with the
            last step that was computed whole.
        warmup: how many steps, from the first, are computed whole; at least 1.
        closes: compute the last step whole.
    """

    name: str
    always: int
    threshold: float
    polynomial: tuple[float, ...]
    accumulates: bool
    warmup: int
    closes: bool

    def __post_init__(self) -> None:
        numbers = (self.threshold, *self.polynomial)
        if self.always < 0 or self.warmup < 1 or not self.polynomial or not all(np.isfinite(numbers)):
            raise ArtifactError(
                f"the criterion {self.name!r} has always = {self.always}, warmup = {self.warmup}, threshold ="
                f" {self.threshold}, polynomial = {self.polynomial}; expected always of at least 0, warmup of at"
                " least 1 and finite numbers. Calibrate again."
            )

    def record(self) -> dict[str, Any]:
        """As JSON."""
        return {**asdict(self), "polynomial": list(self.polynomial)}

    def begin(self, steps: int, blocks: int, streams: int) -> Decisions:
        """The decisions of one call; to be made anew for each call.

        Args:
            steps: K, the number of denoising steps.
            blocks: number of residual blocks.
            streams: B, the number of streams.

        Raises:
            IllegalPlanError: the policy has no block after the first ``always`` ones.
        """
        if self.always >= blocks:
            raise IllegalPlanError(
                f"the criterion {self.name!r} computes the first {self.always} blocks at every step; the policy has"
                f" {blocks}, so that nothing is left to decide. Calibrate again."
            )
        return Decisions(self, steps, blocks, streams)


class Decisions:
    """What a criterion decides during one call of B streams. Streams do not influence each other.

    Args:
        criterion: the rule that decides.
        steps: K, the number of denoising steps.
        blocks: number of residual blocks.
        streams: B, the number of streams.
    """

    def __init__(self, criterion: Criterion, steps: int, blocks: int, streams: int) -> None:
        self._criterion, self._steps, self._blocks = criterion, steps, blocks
        self._accumulated = np.zeros(streams)
        self._compared: npt.NDArray[np.float32] = np.empty((streams, 0), np.float32)

    def decide(self, k: int, feature: npt.NDArray[np.float32]) -> PlanArray:
        """The row of the plan at step k; to be asked for every step, in order.

        Args:
            k: the number of the step.
            feature: ``[B, ...]``, see ``Criterion.always``.

        Returns:
            int8 ``[B, blocks]`` of COMPUTE and TIMESTEP; the first ``always`` blocks are COMPUTE.
        """
        rule = self._criterion
        flat = feature.reshape(len(feature), -1)
        whole = self._whole(k, flat)
        if rule.accumulates or k == 0:
            self._compared = flat.copy()
        else:
            self._compared[whole] = flat[whole]
        row = np.full((len(flat), self._blocks), Source.COMPUTE, np.int8)
        row[~whole, rule.always :] = Source.TIMESTEP
        return row

    def _whole(self, k: int, flat: npt.NDArray[np.float32]) -> BoolArray:
        """Which streams compute all blocks at step k."""
        rule = self._criterion
        if k == 0:
            return np.ones(len(flat), np.bool_)
        change = relative_change(flat, self._compared)
        estimate = np.maximum(np.polyval(rule.polynomial, change), 0)
        if rule.accumulates:
            self._accumulated += estimate
            estimate = self._accumulated
        whole: BoolArray = estimate >= rule.threshold
        if k < rule.warmup or (rule.closes and k == self._steps - 1):
            whole = np.ones(len(flat), np.bool_)
        self._accumulated[whole] = 0
        return whole


def relative_change(now: npt.NDArray[np.float32], before: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Mean absolute difference over mean absolute value before, of each row: ``[B, ...]`` twice gives ``[B]``."""
    rows = len(now)
    difference = np.abs(now - before).reshape(rows, -1).mean(1, dtype=np.float64)
    size = np.abs(before).reshape(rows, -1).mean(1, dtype=np.float64)
    return np.asarray(difference / np.maximum(size, _TINY))
