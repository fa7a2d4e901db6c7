"""The observation window: frames as they come in, To of them at the policy's rate as they go out. No clock, no threads.

Frames may come faster than the policy's rate, late, or out of order. A window is the newest frame and, for each of the
To - 1 before it, the frame nearest to where it should be, if one is near enough: no frame is ever repeated, because
that would tell the policy that nothing moves.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ttscompile.core.coercion import Array
from ttscompile.core.spec import ChunkSpec, ObservationSpec
from ttscompile.core.values import check_values
from ttscompile.errors import ObservationError
from ttscompile.runtimes.arrays import image_remedy, read_observation

Frame: TypeAlias = dict[str, Array]

MOST_FRAMES = 1024
"""Frames that are kept at most. At usual rates they are thrown away by age long before; at several kilohertz some are
left out, so that those which are kept go back far enough for a window."""

_TIME = itemgetter(0)
"""Of a frame that is kept."""


@dataclass(frozen=True)
class FrameSpec:
    """What one frame holds.

    Attributes:
        specs: by key, of one frame.
        history: keys of which the policy sees To frames; of the others it sees the newest.
        steps: To; 1 if there is no history.
        action: which numbers have to be a pose, since actions are relative to them; None where that is not known.
    """

    specs: Mapping[str, ObservationSpec]
    history: frozenset[str]
    steps: int
    action: ChunkSpec | None = None

    @classmethod
    def of(cls, specs: Mapping[str, ObservationSpec], steps: int, action: ChunkSpec | None = None) -> FrameSpec:
        """The frame of a policy whose window has ``steps`` frames.

        A key is a history if its first axis is time, and of the length ``steps``.
        """
        history = frozenset(key for key, spec in specs.items() if spec.frames == steps)
        frame = {key: spec.one_frame if key in history else spec for key, spec in specs.items()}
        return cls(frame, history, steps if history else 1, action)

    def check(self, obs: Mapping[str, Any]) -> Frame:
        """One frame as numpy arrays of its own, which the caller may not change any more.

        Raises:
            ObservationError: a key, a shape, a dtype or a number is not such as the policy takes.
        """
        arrays, _ = read_observation(obs, self.specs)
        frame = {key: self._own(key, array, self.specs[key]) for key, array in arrays.items()}
        if self.action is not None:  # which refuses a measured pose without a rotation: better here than in a call
            self.action.reference({key: array[None] for key, array in frame.items()})
        return frame

    def _own(self, key: str, array: Array, spec: ObservationSpec) -> Array:
        if array.shape != spec.shape or array.dtype != spec.dtype:
            remedy = image_remedy(array[None], spec).strip() or "Convert it with .astype." * (array.shape == spec.shape)
            if array.shape[1:] == spec.shape:
                remedy = f"Give one frame of one robot, [0] say; the executor makes the window of {self.steps}."
            what = f"one frame of observation {key!r} must be {spec.dtype} {list(spec.shape)}"
            raise ObservationError(f"{what}; found {array.dtype!s:.80} {list(array.shape)}. {remedy}".rstrip())
        own = array.copy()  # and then looked at: another thread may write into the caller's
        check_values(own, spec, f"observation {key!r}", ObservationError)
        return own

    def observation(self, frames: list[Frame]) -> dict[str, Array]:
        """What the policy is called with, ``[1, ...]`` a key, from a window's frames, oldest first."""
        newest = frames[-1]
        return {
            key: np.stack([frame[key] for frame in frames])[None] if key in self.history else newest[key][None]
            for key in self.specs
        }

    def alone(self, frame: Frame) -> dict[str, Array]:
        """One frame as ``prepare_frame`` takes it, ``[1, ...]`` a key; of a key with another window its newest."""
        return {key: value[None] if self.specs[key].frames is None else value[-1:] for key, value in frame.items()}

    @property
    def seen_before(self) -> bool:
        """Whether a call reads pictures that are not of its newest frame, if it reads any."""
        pictures = {key for key, spec in self.specs.items() if len(spec.one_frame.shape) >= 3}
        return not pictures or not self.history.isdisjoint(pictures)


class Window(NamedTuple):
    """A complete window: when its newest frame was taken, in seconds; and its To frames, oldest first."""

    time: float
    frames: list[Frame]


class ObservationWindow:
    """The frames of one episode that are recent enough to be part of a window.

    Args:
        steps: To.
        period: seconds between the frames of a window.
        tolerance: how far from its place a frame may be, as a share of the period.
        max_age: seconds that the newest frame of a window may be old.

    Attributes:
        complete: the newest complete window; None if there is none.
        delay: seconds from when the newest frame was taken to when it came.
    """

    def __init__(self, steps: int, period: float, tolerance: float, max_age: float) -> None:
        self._steps, self._period, self._slack = steps, period, tolerance * period
        self._keep = max_age + (steps - 1) * period + self._slack  # older ones are part of windows that are too old
        self._apart = 2 * steps * period / MOST_FRAMES  # of frames in a row, from one to the next but one
        self._frames: list[tuple[float, Frame]] = []  # one list: the handler of a signal may raise between two changes
        self._first = float("inf")  # time of the first frame
        self._late, self._behind = 0, 0.0  # frames in a row that were thrown away, and how old the last one was
        self.complete: Window | None = None
        self.delay = 0.0

    @property
    def interval(self) -> float:
        """Seconds until the next frame is to be expected: what the last two were apart, the policy's period at most."""
        frames = self._frames
        return min(frames[-1][0] - frames[-2][0], self._period) if len(frames) > 1 else self._period

    def add(self, time: float, frame: Frame, now: float) -> str:
        """Take a frame.

        Returns:
            ``added``; ``replaced`` if there was one of the same time; or ``late``: too old to be part of a window, and
            thrown away.
        """
        frames = self._frames
        self._late, self._behind = self._late + 1, now - time
        place = bisect_left(frames, time, key=_TIME)
        if place < len(frames) and frames[place][0] == time:
            frames[place] = time, frame
            self.complete, self._late = self._newest(place), 0
            return "replaced"
        if time < now - self._keep:
            return "late"
        self._first = min(self._first, time)
        if place == len(frames):
            self.delay = max(now - time, 0.0)
        frames.insert(place, (time, frame))
        middle = min(place, len(frames) - 2)  # the newest frame is never left out
        if middle > 0 and frames[middle + 1][0] - frames[middle - 1][0] < self._apart:
            del frames[middle]
            place = middle
        gone = max(bisect_left(frames, frames[-1][0] - self._keep, key=_TIME), len(frames) - MOST_FRAMES, 0)
        del frames[:gone]
        if place < gone:
            return "late"
        self.complete, self._late = self._newest(place - gone), 0
        return "added"

    @property
    def trouble(self) -> str:
        """Why there is no complete window, where frames came for longer than one takes; else empty."""
        return self.why_incomplete() if self.complete is None and self._overdue else ""

    @property
    def _overdue(self) -> bool:
        """Whether frames came for longer than a window takes, or more than it has were thrown away."""
        lasts = (self._steps - 1) * self._period + self._slack
        newest = self._first if self.newest is None else self.newest
        return self._late > self._steps or newest > self._first + lasts + 1e-9

    @property
    def newest(self) -> float | None:
        """When the newest frame was taken; None before the first."""
        return self._frames[-1][0] if self._frames else None

    def before(self, time: float) -> list[Frame]:
        """Of the To - 1 frames that stand before one of a time those that have come, newest first.

        One that is not where it should be is left out, if the next frame is expected nearer to that.
        """
        found, before = list[Frame](), len(self._frames)
        for back in range(1, self._steps):
            place = time - back * self._period
            nearest = self._nearest(place, before)
            if nearest >= 0 and abs(self._frames[nearest][0] - place) <= self.interval / 2 + 1e-6:
                found.append(self._frames[nearest][1])
                before = nearest
        return found

    def why_incomplete(self) -> str:
        """What a complete window lacks, for people."""
        found = len(self._frames)
        if found < self._steps and self._late:
            told = f"the last one {self._behind:.4g} s after it was taken, and {self._keep:.2g} s is the most"
            remedy = "Stamp frames with time.monotonic(), or with the executor's clock, and give them sooner"
            return f"frames came too late and were thrown away, {self._late} in a row; {told}. {remedy}"
        if found < self._steps and not self._overdue:
            return f"{found} of {self._steps} frames came"
        gaps = np.diff([time for time, _ in self._frames[-self._steps :]])
        apart = ", ".join(f"{gap:.4g}" for gap in gaps) or f"more than {self._keep:.2g}"
        return (
            f"the policy wants {self._steps} frames every {self._period:.4g} s, to within {self._slack:.2g} s; the"
            f" newest came {apart} s apart. Set policy_hz to the rate of training, and give frames at a multiple of it"
        )

    def _newest(self, changed: int) -> Window | None:
        """The newest complete window after the frame of this index has changed: older ones are what they were."""
        for newest in range(len(self._frames) - 1, max(changed, self._steps - 1) - 1, -1):
            found = self._window(newest)
            if found is not None:
                return found
        return self.complete

    def _window(self, newest: int) -> Window | None:
        """The window whose newest frame has this index; None if it is not complete."""
        time, chosen, before = self._frames[newest][0], [newest], newest
        for back in range(1, self._steps):
            before = self._nearest(time - back * self._period, before)
            if before < 0:
                return None
            chosen.append(before)
        return Window(time, [self._frames[i][1] for i in reversed(chosen)])

    def _nearest(self, time: float, before: int) -> int:
        """Index under ``before`` of the frame nearest to ``time``; -1 if none is within the tolerance."""
        right = bisect_left(self._frames, time, 0, before, key=_TIME)
        off = {i: abs(self._frames[i][0] - time) for i in (right - 1, right) if 0 <= i < before}
        return min((i for i in off if off[i] <= self._slack + 1e-9), key=off.__getitem__, default=-1)
