"""What a chunk must be before any of it is executed; and a watchdog for a policy that has stopped moving.

No clock, no threads.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import copysign

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
            loop that skips ticks, or goes on after an error without a reset, sees the changes of all of them at once,
            unless ``clip`` is set.
        max_jerk: largest third difference over control ticks, ``a[3] - 3 a[2] + 3 a[1] - a[0]``; None for no limit.
        clip: whether actions are changed where a chunk would be refused for its bounds or its steps: each number is
            clipped to ``low`` and ``high``, and each action comes as near to what it was as it can within ``max_step``
            of the one given out before. What is not finite, or exceeds ``max_jerk``, is refused all the same.
    """

    low: float | Sequence[float] | None = None
    high: float | Sequence[float] | None = None
    margin: float = 0.05
    max_step: float | Sequence[float] | None = None
    max_jerk: float | Sequence[float] | None = None
    clip: bool = False

    def __post_init__(self) -> None:
        if not self.margin >= 0:
            raise ExecutorError(f"the guard's margin must not be negative; found {self.margin}.")
        if not isinstance(self.clip, bool):
            raise ExecutorError(f"the guard's clip must be True or False; found {self.clip!r}.")
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
        ExecutorError: a limit has another number of channels, the bounds leave no room, or there is nothing to clip to.

    Attributes:
        clips: whether actions are changed so that they keep the limits.
    """

    def __init__(self, limits: GuardLimits, normalizer: Affine | None, channels: int) -> None:
        if not isinstance(limits, GuardLimits):
            raise ExecutorError(f"the guard must be GuardLimits; found {limits!r:.80}.")
        unlimited = np.full(channels, np.inf, np.float32)
        low, high = -unlimited, unlimited
        if normalizer is not None:
            ends = np.stack([normalizer.unnormalize(np.full(channels, end, np.float32)) for end in (-1.0, 1.0)])
            low, high = (f(ends.reshape(-1, channels), axis=0) for f in (np.min, np.max))  # of all steps with a row
            low, high = low - limits.margin * (high - low), high + limits.margin * (high - low)
        self._low = _vector(limits.low, channels, "low", low)
        self._high = _vector(limits.high, channels, "high", high)
        if not (self._low < self._high).all():
            raise ExecutorError(f"the guard's bounds leave no room: low {self._low} is not below high {self._high}.")
        self._max_step = None if limits.max_step is None else _vector(limits.max_step, channels, "max_step", unlimited)
        self._max_jerk = None if limits.max_jerk is None else _vector(limits.max_jerk, channels, "max_jerk", unlimited)
        self.clips = limits.clip
        if self.clips and self._max_step is None and not np.isfinite([self._low, self._high]).any():
            what = "the guard's clip has nothing to clip to: the normaliser of the actions has no range"
            raise ExecutorError(f"{what}. Give low and high, or max_step.")

    def refuse(self, actions: FloatArray) -> str | None:
        """Why a chunk ``[Ta, Da]`` must not be executed; None if nothing is wrong with it by itself."""
        if not np.isfinite(actions).all():
            return f"{np.count_nonzero(~np.isfinite(actions))} of its {actions.size} numbers are not finite"
        outside = (actions < self._low) | (actions > self._high)
        if outside.any() and not self.clips:
            i, d = (int(n) for n in np.argwhere(outside)[0])
            bounds = f"{self._low[d]:.6g} to {self._high[d]:.6g}"
            return f"action {i}, channel {d}, is {actions[i, d]:.6g}; the bounds are {bounds}"
        return None

    def bounded(self, rows: FloatArray) -> FloatArray:
        """Actions ``[N, Da]``, clipped to the bounds."""
        return np.clip(rows, self._low, self._high)

    def limited(self, played: FloatArray, scheduled: FloatArray) -> FloatArray:
        """A schedule that keeps the bounds and ``max_step``, with each action as near to what it was as they allow.

        Args:
            played: the last actions that were given out, ``[N, Da]``, oldest first; at most one counts.
            scheduled: ``[M, Da]``, what follows.
        """
        joined = np.concatenate([played[-1:], self.bounded(scheduled)])
        if self._max_step is not None:
            over = np.abs(np.diff(joined.astype(np.float64), axis=0)) > self._max_step
            for d in np.flatnonzero(over.any(axis=0)):
                column, most = joined[:, d].tolist(), float(self._max_step[d])
                room = max(most - float(np.spacing(np.abs(joined[:, d]).max())), 0.0)  # rounding changes less than that
                for i in range(1, len(column)):
                    if abs(step := column[i] - column[i - 1]) > most:
                        column[i] = float(np.float32(column[i - 1] + copysign(room, step)))
                joined[:, d] = column
        return joined[-len(scheduled) :]

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
            if limit is None or len(joined) <= order or (order == 1 and self.clips):
                continue
            size = np.abs(np.diff(joined, order, axis=0))
            excess = size - limit
            if (excess > 0).any():
                i, d = (int(n) for n in np.unravel_index(np.argmax(excess), excess.shape))
                return f"its {name} of {size[i, d]:.6g} in channel {d} exceeds the limit of {limit[d]:.6g}"
        return None


def _numbers(limit: float | Sequence[float], name: str) -> FloatArray:
    return numbers(limit, f"the guard's {name}", ExecutorError)


def _vector(limit: float | Sequence[float] | None, channels: int, name: str, default: FloatArray) -> FloatArray:
    if limit is None:
        return default
    array = _numbers(limit, name)
    if array.shape not in ((), (channels,)) or np.isnan(array).any():
        expected = f"a number, or one for each of {channels} channels"
        raise ExecutorError(f"the guard's {name} must be {expected}; found {limit}.")
    return np.broadcast_to(array, (channels,))


@dataclass(frozen=True)
class StallRule:
    """When a policy has stopped moving, and what is done about it; see ``ExecutorSettings.stall_after``.

    Attributes:
        ticks: for which the actions have to stay where they are.
        reach: float32 ``[Da]``, how far from the first of them they may be, in their own units.
        plan: that the next call runs then.
        summed: channels that are displacements: what they add up to says where the robot is.
    """

    ticks: int
    reach: FloatArray
    plan: str
    summed: tuple[int, ...] = ()


class Watchdog:
    """Looks at the actions of one episode; a rule of None never finds anything."""

    def __init__(self, rule: StallRule | None) -> None:
        self._rule, self._sum = rule, np.zeros(0 if rule is None else len(rule.reach), np.float32)
        self.restart()

    def restart(self) -> None:
        """Look at the actions from here on alone."""
        self._first: FloatArray | None = None
        self._still = 0  # ticks after the first

    @property
    def plan(self) -> str | None:
        """The plan that the next call shall run, because the actions have stopped moving; None if they have not."""
        return None if self._rule is None or self._still < self._rule.ticks else self._rule.plan

    def give(self, action: FloatArray) -> bool:
        """Take note that an action ``[Da]`` was given out; whether ``plan`` is another one now."""
        if self._rule is None:
            return False
        before, summed = self.plan, list(self._rule.summed)
        self._sum = self._sum + action
        action = action.copy()
        action[summed] = self._sum[summed]
        if self._first is not None and (np.abs(action - self._first) <= self._rule.reach).all():
            self._still += 1
        else:
            self._first, self._still = action, 0
        return self.plan != before
