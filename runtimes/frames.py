"""What was computed for a frame, by the frame's content: unchanged cameras and instructions cost nothing.

A frame is known by its bytes, never by its place or its time. So nothing stale can be read, whatever comes late, twice
or never: another frame has other bytes. Frames are computed one at a time, so that what is remembered has the very bits
that would be computed again.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ttscompile.artifact.manifest import PieceRecord
from ttscompile.ir.pieces import FRAMES, frame_pieces

Array: TypeAlias = npt.NDArray[Any]
Content: TypeAlias = tuple[bytes, ...]
"""The bytes of one frame, of each input of the piece that reads it."""
Run: TypeAlias = Callable[[str, Mapping[str, Array]], tuple[Array, ...]]
"""A piece, by its name, on inputs by theirs; its outputs in order."""
Stop: TypeAlias = Callable[[], bool]
Compute: TypeAlias = Callable[[Sequence[Array]], tuple[Array, ...]]
"""One row of each input of a frame piece, ``[1, ...]``, to what it gives for it, ``[1, ...]`` each."""


def _never() -> bool:
    return False


WINDOWS = 2
"""How many calls' rows are remembered: those of the last one, and those that have come since."""


@dataclass(frozen=True)
class FrameWork:
    """What frame pieces did for a call.

    Attributes:
        computed: frames that were computed while the call waited.
        remembered: frames that were known.
        waited: ms that computing took.
        saved: ms that those remembered took when they were computed.
    """

    computed: int = 0
    remembered: int = 0
    waited: float = 0.0
    saved: float = 0.0

    def __add__(self, other: FrameWork) -> FrameWork:
        return FrameWork(
            self.computed + other.computed,
            self.remembered + other.remembered,
            self.waited + other.waited,
            self.saved + other.saved,
        )


@dataclass(frozen=True, eq=False)
class _Known:
    values: tuple[Array, ...]
    took: float  # ms


class FrameMemory:
    """The rows of one frame piece that were computed last."""

    def __init__(self) -> None:
        self._known: OrderedDict[Content, _Known] = OrderedDict()

    def __len__(self) -> int:
        return len(self._known)

    def forget(self) -> None:
        """Forget all."""
        self._known.clear()

    def learn(
        self, contents: Sequence[Content], rows: Sequence[Array], compute: Compute, stop: Stop = _never
    ) -> FrameWork:
        """Compute the rows that are not known; nothing is kept of one whose computing fails.

        Args:
            contents: of the rows.
            rows: of each input of the piece ``[N, ...]``.
            compute: asked once for each new row.
            stop: asked before each; the rest is left out if it says so.
        """
        work = FrameWork()
        for i, content in enumerate(contents):
            known = self._known.get(content)
            if known is not None:
                self._known.move_to_end(content)
                work += FrameWork(remembered=1, saved=known.took)
                continue
            if stop():
                break
            start = time.perf_counter()
            values = compute([each[i : i + 1] for each in rows])
            took = 1000.0 * (time.perf_counter() - start)
            self._known[content] = _Known(values, took)
            work += FrameWork(computed=1, waited=took)
        while len(self._known) > WINDOWS * len(contents):
            self._known.popitem(last=False)
        return work

    def values(self, contents: Sequence[Content]) -> tuple[Array, ...]:
        """What the piece gives for rows of these contents, ``[N, ...]`` each; they must be known."""
        found = [self._known[content].values for content in contents]
        return tuple(np.concatenate(each) for each in zip(*found, strict=True))


def contents_of(rows: Sequence[Array]) -> list[Content]:
    """The content of each row, of the inputs of a piece ``[N, ...]``."""
    return [tuple(row.tobytes() for row in one) for one in zip(*rows, strict=True)]


class FramePieces:
    """What depends on one frame alone, for the rows of all streams: only frames that are new are computed.

    Args:
        pieces: of the artifact; without frame pieces nothing is done.
        run: executes one of them.

    Attributes:
        work: what the last ``values`` did.
    """

    def __init__(self, pieces: Mapping[str, PieceRecord], run: Run) -> None:
        self._rows, self._run = pieces.get(FRAMES), run
        self._pieces = {name: pieces[name] for name in frame_pieces(pieces)}
        self._memory = {name: FrameMemory() for name in self._pieces}
        self.work = FrameWork()

    def __len__(self) -> int:
        return len(self._pieces)

    def forget(self) -> None:
        """Forget all frames."""
        for memory in self._memory.values():
            memory.forget()

    def learn(self, obs: Mapping[str, Array], stop: Stop = _never) -> FrameWork:
        """Compute what is new in normalised observations ``[B, ...]``, until ``stop`` says so."""
        rows, work = self._rows_of(obs), FrameWork()
        for name, piece in self._pieces.items():
            own = [rows[n] for n in piece.inputs]
            work += self._memory[name].learn(contents_of(own), own, partial(self._compute, name), stop)
        return work

    def values(self, obs: Mapping[str, Array]) -> dict[str, Array]:
        """What the condition piece reads beside normalised observations ``[B, ...]``; nothing without frame pieces."""
        rows, found, self.work = self._rows_of(obs), dict[str, Array](), FrameWork()
        for name, piece in self._pieces.items():
            own, memory = [rows[n] for n in piece.inputs], self._memory[name]
            contents = contents_of(own)
            self.work += memory.learn(contents, own, partial(self._compute, name))
            found |= zip(piece.outputs, memory.values(contents), strict=True)
        return found

    def _rows_of(self, obs: Mapping[str, Array]) -> dict[str, Array]:
        if self._rows is None:
            return {}
        feed = {name: np.ascontiguousarray(obs[name]) for name in self._rows.inputs}
        return dict(zip(self._rows.outputs, self._run(FRAMES, feed), strict=True))

    def _compute(self, name: str, row: Sequence[Array]) -> tuple[Array, ...]:
        return self._run(name, dict(zip(self._pieces[name].inputs, row, strict=True)))


NO_FRAMES = FramePieces({}, lambda name, feed: ())
"""Of a backend that computes every frame in every call."""
