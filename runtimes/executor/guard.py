"""What a chunk must be before any of it is executed. No clock, no threads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ttscompile.core.coercion import numbers
from ttscompile.core.spec import Affine, FloatArray
from ttscompile.errors import ExecutorError


@dataclass(frozen=True)
class GuardLimits:
    """Limits on actions, in the units of the actions; numbers, or one a channel.

    Attributes:
        low: least action; None for what the normaliser maps to -1, ``margin`` further out.
        high: largest action; None for what the normaliser maps to 1, ``margin`` further out.
        margin: share of the normaliser's range by which an action may be outside of it. A normaliser by mean and
            deviation, or by quantiles, has no range, and sets no bounds: give ``low`` and ``high``.
        max_step: largest change of an action from one control tick to the next, seams included; None for no limit. A
            loop that skips ticks, or goes on after an error without a reset, sees the changes of all of them at once.
        max_jerk: largest third difference over control ticks, ``a[3] - 3 a[2] + 3 a[1] - a[0]``; None for no limit.
    """

    low: float | Sequence[float] | None = None
    high: float | Sequence[float] | None = None
    margin: float = 0.05
    max_step: float | Sequence[float] | None = None
    max_jerk: float | Sequence[float] | None = None

    def __post_init__(self) -> None:
        if not self.margin >= 0:
            raise ExecutorError(f"the guard's margin must not be negative; found {self.margin}.")
        for name in ("max_step", "max_jerk"):
            limit = getattr(self, name)
            if limit is not None and not (_numbers(limit, name) > 0).all():
                raise ExecutorError(f"the guard's {name} must be positive; found {limit}.")


class Guard:
    """Checks chunks.

    Args:
        normalizer: of the actions; None if the policy has none that knows their range (``ChunkSpec.ranged``), and so
            no bounds but the ones in ``limits``.

    Raises:
        ExecutorError: a limit has another number of channels, or the bounds leave no room.
    """

    def __init__(self, limits: GuardLimits, normalizer: Affine | None, channels: int) -> None:
        unlimited = np.full(channels, np.inf, np.float32)
        low, high = -unlimited, unlimited
        if normalizer is not None:
            ends = np.stack([normalizer.unnormalize(np.full(channels, end, np.float32)) for end in (-1.0, 1.0)])
            low, high = ends.min(axis=0), ends.max(axis=0)
            low, high = low - limits.margin * (high - low), high + limits.margin * (high - low)
        self._low = _vector(limits.low, channels, "low", low)
        self._high = _vector(limits.high, channels, "high", high)
        if not (self._low < self._high).all():
            raise ExecutorError(f"the guard's bounds leave no room: low {self._low} is not below high {self._high}.")
        self._max_step = None if limits.max_step is None else _vector(limits.max_step, channels, "max_step", unlimited)
        self._max_jerk = None if limits.max_jerk is None else _vector(limits.max_jerk, channels, "max_jerk", unlimited)

    def refuse(self, actions: FloatArray) -> str | None:
        """Why a chunk ``[Ta, Da]`` must not be executed; None if nothing is wrong with it by itself."""
        if not np.isfinite(actions).all():
            return f"{np.count_nonzero(~np.isfinite(actions))} of its {actions.size} numbers are not finite"
        outside = (actions < self._low) | (actions > self._high)
        if outside.any():
            i, d = (int(n) for n in np.argwhere(outside)[0])
            bounds = f"{self._low[d]:.6g} to {self._high[d]:.6g}"
            return f"action {i}, channel {d}, is {actions[i, d]:.6g}; the bounds are {bounds}"
        return None

    def refuse_motion(self, played: FloatArray, scheduled: FloatArray) -> str | None:
        """Why a schedule must not follow what was played.

        Args:
            played: the last actions that were given out, ``[N, Da]``, oldest first; at most three count.
            scheduled: ``[M, Da]``, what would follow.

        Returns:
            The reason, or None.
        """
        if self._max_step is None and self._max_jerk is None:
            return None
        for name, limit, order in (("step", self._max_step, 1), ("jerk", self._max_jerk, 3)):
            joined = np.concatenate([played[-order:], scheduled]).astype(np.float64)
            if limit is None or len(joined) <= order:
                continue
            size = np.abs(np.diff(joined, order, axis=0))
            excess = size - limit
            if (excess > 0).any():
                i, d = (int(n) for n in np.unravel_index(np.argmax(excess), excess.shape))
                return f"its {name} of {size[i, d]:.6g} in channel {d} exceeds the limit of {limit[d]:.6g}"
        return None


def _numbers(limit: float | Sequence[float], name: str) -> FloatArray:
    """A limit as an array of the shape that it was given in."""
    return numbers(limit, f"the guard's {name}", ExecutorError)


def _vector(limit: float | Sequence[float] | None, channels: int, name: str, default: FloatArray) -> FloatArray:
    """A limit as one number a channel."""
    if limit is None:
        return default
    array = _numbers(limit, name)
    if array.shape not in ((), (channels,)) or np.isnan(array).any():
        expected = f"a number, or one for each of {channels} channels"
        raise ExecutorError(f"the guard's {name} must be {expected}; found {limit}.")
    return np.broadcast_to(array, (channels,))
