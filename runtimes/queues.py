"""What ``select_action`` keeps between calls: the last To frames of each observation, and actions not executed yet.

The semantics are LeRobot's: the first frame of an episode stands for those before it, and a chunk is executed to its
end before the next one is computed.
"""

from collections import deque
from collections.abc import Mapping

import numpy as np

from ttscompile.core.coercion import Array, Arrays
from ttscompile.core.spec import FloatArray, ObservationSpec
from ttscompile.errors import ObservationError

from .arrays import check_observation

Frames = dict[str, deque[Array]]


class Queues:
    """Frames and actions of one episode."""

    def __init__(self, specs: Mapping[str, ObservationSpec]) -> None:
        self._specs = specs
        self._frame_specs = {key: spec.one_frame for key, spec in specs.items()}
        self._frames: Frames = {}
        self._actions: deque[FloatArray] = deque()

    def reset(self) -> None:
        """A new episode."""
        self._frames, self._actions = {}, deque()

    def after(self, frame: Arrays) -> Frames:
        """The frames with one more of every stream; the first of an episode fills the window. Nothing is kept yet.

        A call that fails after this, and is made again, must not push its frame twice: ``keep`` what it used when it
        succeeded. Of a window's key ``frame`` has one frame.
        """
        own = check_observation(frame, self._frame_specs)
        streams = len(next(iter(own.values())))
        before = len(next(iter(self._frames.values()))[-1]) if self._frames else streams
        if streams != before:
            found = f"the frame holds {streams} streams, and the frames before {before}"
            raise ObservationError(f"{found}. The number of streams may change only after reset().")
        frames: Frames = {}
        for key, value in own.items():
            length = self._specs[key].frames or 1
            frames[key] = deque(self._frames.get(key, [value] * length), maxlen=length)
            frames[key].append(value)
        return frames

    def keep(self, frames: Frames) -> None:
        """Keep what ``after`` gave."""
        self._frames = frames

    def observation(self, frames: Frames) -> dict[str, Array]:
        """The window as ``predict_action`` takes it: by key ``[B, To, ...]``; of a key without frames the newest."""
        return {
            key: values[-1] if self._specs[key].frames is None else np.stack(values, axis=1)
            for key, values in frames.items()
        }

    @property
    def queued(self) -> int:
        """How many actions were not executed yet."""
        return len(self._actions)

    def extend(self, actions: FloatArray) -> None:
        """Add a chunk of actions ``[B, Ta, Da]``."""
        self._actions.extend(actions[:, k] for k in range(actions.shape[1]))

    def pop(self) -> FloatArray:
        """The next actions ``[B, Da]``."""
        return self._actions.popleft()


def is_window(arrays: Arrays, specs: Mapping[str, ObservationSpec]) -> bool:
    """Whether these are whole windows ``[B, To, ...]`` rather than one frame ``[B, ...]`` of each."""
    return all(arrays[key].ndim == len(spec.shape) + 1 for key, spec in specs.items() if spec.frames is not None)
