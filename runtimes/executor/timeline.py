"""What is played when: actions by control tick, and how a new chunk joins what is scheduled. No clock, no threads.

Time is cut into control ticks. A tick is *consumed* when its action has been given out; a new chunk starts to count at
the first tick that is not, however long its inference took. Only the first of an episode begins at its beginning, with
the first action that is asked for (``Schedule.begin``)::

    tick        10   11   12   13   14   15   16   17
    scheduled    a    a    a    a    a                      chunk a, observed at tick 8
    consumed     x    x    x                                given out while b was computed
    chunk b      .    .    .    b    b    b    b    b       observed at tick 10: its first three actions are overdue
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import floor

import numpy as np
import numpy.typing as npt

from ttscompile.core.coercion import Array
from ttscompile.core.spec import FloatArray

FOLLOW = 0.05
"""Share of its distance from the middle of a tick by which each action moves the grid."""


class TickGrid:
    """From seconds to control ticks and back.

    The first observation of an episode says where tick 0 is. The first action that is given out moves the grid by less
    than half a tick, so that the control loop stands in the middle of its ticks and its jitter skips none; those after
    it move it a little, so that a loop whose rate is not exactly what was declared stays there. A rate that is more
    than ``FOLLOW / 2`` off is not followed: then ticks are skipped, or asked for twice, to stay with the time.
    """

    def __init__(self, hz: float) -> None:
        self._hz = hz
        self._origin: float | None = None
        self._anchored = False

    def tick(self, time: float) -> int:
        """The nearest tick; makes this time tick 0 if there is none."""
        if self._origin is None:
            self._origin = time
        return floor((time - self._origin) * self._hz + 0.5)

    def follow(self, time: float, tick: int) -> None:
        """Take note that the action of a tick was given out for a time."""
        off = time - self.time(tick)
        assert self._origin is not None  # ``time`` says so
        self._origin += FOLLOW * off if self._anchored else off
        self._anchored = True

    def time(self, tick: int) -> float:
        """Seconds of a tick; there must be a tick 0."""
        assert self._origin is not None  # callers have made a tick of a time
        return self._origin + tick / self._hz


@dataclass(frozen=True)
class Timeline:
    """Scheduled actions.

    Attributes:
        start: tick of the first row.
        rows: float32 ``[N, Da]``, one a tick.
        observed: float64 ``[N]``, time of the newest frame that each row was computed from.
        chunks: int64 ``[N]``, how many chunks each row is the mean of.
        clipped: bool ``[N]``, whether the guard changed the row, or one that it was made from.
    """

    start: int
    rows: FloatArray
    observed: npt.NDArray[np.float64]
    chunks: npt.NDArray[np.int64]
    clipped: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, start: int, rows: FloatArray, observed: float) -> Timeline:
        """The actions of one chunk."""
        number = len(rows)
        return cls(start, rows, np.full(number, observed), np.ones(number, np.int64), np.zeros(number, np.bool_))

    @property
    def end(self) -> int:
        """One past the last tick."""
        return self.start + len(self.rows)

    def between(self, first: int, end: int) -> Timeline:
        """What is scheduled from a tick on, and before another; views."""
        part = slice(max(first - self.start, 0), max(end - self.start, 0))
        return Timeline(self.start + part.start, *(each[part] for each in self._arrays))

    def then(self, other: Timeline) -> Timeline:
        """This, and after its end another."""
        pairs = zip(self._arrays, other._arrays, strict=True)
        return Timeline(self.start, *(np.concatenate(pair) for pair in pairs))

    def clipped_to(self, rows: FloatArray) -> Timeline:
        """The same with rows that the guard made of these."""
        return replace(self, rows=rows, clipped=self.clipped | (rows != self.rows).any(axis=1))

    @property
    def _arrays(self) -> tuple[Array, ...]:
        return self.rows, self.observed, self.chunks, self.clipped

    def at(self, tick: int) -> FloatArray | None:
        """The action of a tick, a view; None if none is scheduled."""
        i = tick - self.start
        return self.rows[i] if 0 <= i < len(self.rows) else None


def expand(actions: FloatArray, ticks_per_step: int, interpolation: str) -> FloatArray:
    """Actions ``[Ta, Da]`` at the policy's rate as actions at the control rate, ``[Ta * ticks_per_step, Da]``.

    With ``hold`` an action is repeated; with ``linear`` it moves evenly to the next, and the last is repeated.
    """
    if ticks_per_step == 1:
        return actions
    if interpolation == "hold":
        return np.repeat(actions, ticks_per_step, axis=0)
    following = np.concatenate([actions[1:], actions[-1:]])
    share = (np.arange(ticks_per_step, dtype=np.float32) / ticks_per_step)[None, :, None]
    between = actions[:, None] * (1 - share) + following[:, None] * share
    return np.asarray(between.reshape(-1, actions.shape[1]), dtype=np.float32)


def splice(
    old: Timeline | None,
    new: Timeline,
    seam: int,
    blend: int = 0,
    ensemble: float | None = None,
    displacements: tuple[int, ...] = (),
) -> Timeline | None:
    """The schedule after a chunk came.

    Args:
        old: what is scheduled so far.
        new: the whole chunk, from the tick of its observation on.
        seam: first tick that is not consumed.
        blend: ticks over which the old actions turn evenly into the new ones, where both are there; 0 to replace them.
        ensemble: coefficient of ``average``, for what both have, and what only the old ones have stays; None for
            neither.
        displacements: channels that do not turn: their sum counts, and it is made up for (``Schedule.add``).

    Returns:
        What is scheduled from ``seam`` on; None if the whole chunk is overdue.
    """
    if new.end <= seam:
        return None
    first = max(seam, new.start)
    made = new.between(first, new.end)
    if old is None:
        return made
    both = old.between(first, made.end)
    if ensemble is not None:
        made = average(both, made, ensemble)
        if old.start <= made.end < old.end:
            made = made.then(old.between(made.end, old.end))
    elif blend and first >= old.start:
        rows, clipped, past = made.rows.copy(), made.clipped.copy(), both.rows[:blend]
        weight = np.repeat(np.arange(1, len(past) + 1, dtype=np.float32)[:, None] / (blend + 1), rows.shape[1], 1)
        weight[:, list(displacements)] = 1
        rows[: len(past)] = past + weight * (rows[: len(past)] - past)
        clipped[: len(past)] |= both.clipped[:blend]
        made = replace(made, rows=rows, clipped=clipped)
    if old.start <= seam < first <= old.end:  # the chunk begins later than what is next
        made = old.between(seam, first).then(made)
    return made


def average(old: Timeline, new: Timeline, coefficient: float) -> Timeline:
    """A chunk, with its mean with what others predicted for the same ticks.

    The weights are ``exp(-coefficient * i)``, i = 0 for the oldest prediction of a tick ("Learning Fine-Grained
    Bimanual Manipulation with Low-Cost Hardware", section IV, arXiv 2304.13705). The mean of n predictions and their
    number are enough to add another one: of all weights it has the share ``w[n] / (w[0] + ... + w[n])``.

    Args:
        old: means so far, of ticks that ``new`` has.
        coefficient: 0 for a plain mean; the larger, the more the oldest prediction counts.
    """
    n, rows, chunks, clipped = old.chunks, new.rows.copy(), new.chunks.copy(), new.clipped.copy()
    if coefficient == 0:
        share = 1 / (n + 1)
    else:  # the sum of the geometric series, in a form that neither overflows nor cancels
        share = np.expm1(-coefficient) / (np.expm1(-coefficient) - np.expm1(np.minimum(coefficient * n, 700)))
    both = slice(old.start - new.start, old.end - new.start)
    rows[both] = old.rows + share[:, None] * (rows[both] - old.rows)
    chunks[both] += n
    clipped[both] |= old.clipped
    return replace(new, rows=rows, chunks=chunks, clipped=clipped)
