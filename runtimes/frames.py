"""What was computed for a frame, by the frame's content: unchanged cameras and instructions cost nothing.

A frame is known by its bytes, never by its place or its time. So nothing stale can be read, whatever comes late, twice
or never: another frame has other bytes. Frames are computed one at a time, so that what is remembered has the very bits
that would be computed again.

Where tokens are reused, what is computed for a frame depends on the frames of its lane that were computed before it. It
is remembered for that lane alone; forgotten and computed again, it may have other numbers.
"""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from ttscompile.artifact.manifest import PieceRecord
from ttscompile.core.coercion import Array
from ttscompile.ir.pieces import FRAMES, frame_pieces

from .tokens import Lane, Run, Seen, TokenTower

Content: TypeAlias = tuple[bytes, ...]
"""The bytes of one frame, of each input of the piece that reads it; before them those of its lane, if it has one."""
Stop: TypeAlias = Callable[[], bool]
Compute: TypeAlias = Callable[[int], tuple[tuple[Array, ...], "FrameWork"]]
"""The number of a row to what a frame piece gives for it, ``[1, ...]`` each, and what was done for its tokens."""

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
        tokens: that were computed of the frames that were.
        forward: that took the rows of a computed one (FORWARD). The others kept their own (ROLLOUT).
        of: how many tokens these frames have; 0 where tokens are not reused.
    """

    computed: int = 0
    remembered: int = 0
    waited: float = 0.0
    saved: float = 0.0
    tokens: int = 0
    forward: int = 0
    of: int = 0

    def __add__(self, other: FrameWork) -> FrameWork:
        return FrameWork(*(mine + theirs for mine, theirs in zip(astuple(self), astuple(other), strict=True)))


class FrameMemory:
    """The rows of one frame piece that were computed last."""

    def __init__(self) -> None:
        self._known: OrderedDict[Content, tuple[tuple[Array, ...], float]] = OrderedDict()  # values, and ms they took

    def __len__(self) -> int:
        return len(self._known)

    def forget(self) -> None:
        """Forget all."""
        self._known.clear()

    def learn(self, contents: Sequence[Content], compute: Compute, stop: Stop = lambda: False) -> FrameWork:
        """Compute the rows that are not known, until ``stop`` says so; nothing is kept of one whose computing fails."""
        work = FrameWork()
        for i, content in enumerate(contents):
            known = self._known.get(content)
            if known is not None:
                self._known.move_to_end(content)
                work += FrameWork(remembered=1, saved=known[1])
                continue
            if stop():
                break
            start = time.perf_counter()
            values, done = compute(i)
            took = 1000.0 * (time.perf_counter() - start)
            self._known[content] = values, took
            work += replace(done, computed=1, waited=took)
        while len(self._known) > WINDOWS * len(contents):
            self._known.popitem(last=False)
        return work

    def values(self, contents: Sequence[Content]) -> tuple[Array, ...]:
        """What the piece gives for rows of these contents, ``[N, ...]`` each; they must be known."""
        found = [self._known[content][0] for content in contents]
        return tuple(np.concatenate(each) for each in zip(*found, strict=True))


def contents_of(rows: Sequence[Array], lanes: Sequence[Lane] = ()) -> list[Content]:
    """The content of each row, of the inputs of a piece ``[N, ...]``.

    Args:
        rows: of each input.
        lanes: of the rows, where what is given for one depends on the frames of its lane before it.
    """
    own = [[lane] for lane in lanes] or [[] for _ in rows[0]]
    return [(*lane, *(row.tobytes() for row in one)) for lane, *one in zip(own, *rows, strict=True)]


class FramePieces:
    """What depends on one frame alone, for the rows of all streams: only frames that are new are computed.

    Attributes:
        work: what the last ``values`` did.
    """

    def __init__(
        self, pieces: Mapping[str, PieceRecord], run: Run, tokens: Mapping[str, TokenTower] = MappingProxyType({})
    ) -> None:
        self._rows, self._run, self._tokens = pieces.get(FRAMES), run, tokens
        self._pieces = {name: pieces[name] for name in frame_pieces(pieces)}
        self._memory = {name: FrameMemory() for name in self._pieces}
        self._lanes: dict[tuple[str, int], Sequence[Lane]] = {}  # by piece and number of streams
        self.work = FrameWork()

    def __len__(self) -> int:
        return len(self._pieces)

    @property
    def reuses_tokens(self) -> bool:
        """Whether of some frames only some tokens are computed."""
        return bool(self._tokens)

    def seen(self) -> tuple[Seen, ...]:
        """What is seen of each camera of each stream whose tokens are reused; nothing after ``forget``."""
        lanes = ((name, dict.fromkeys(lanes)) for (name, _), lanes in self._lanes.items())
        return tuple(one for name, own in lanes for one in self._tokens[name].seen(own))

    def forget(self) -> None:
        """Forget all frames."""
        for memory in self._memory.values():
            memory.forget()
        for tower in self._tokens.values():
            tower.forget()

    def learn(self, obs: Mapping[str, Array], stop: Stop = lambda: False) -> FrameWork:
        """Compute what is new in normalised observations ``[B, ...]``, until ``stop`` says so."""
        return self._learned(obs, stop)[0]

    def values(self, obs: Mapping[str, Array]) -> dict[str, Array]:
        """What the condition piece reads beside normalised observations ``[B, ...]``; nothing without frame pieces."""
        found = dict[str, Array]()
        self.work, known = self._learned(obs, lambda: False)
        for name, contents in known.items():
            found |= zip(self._pieces[name].outputs, self._memory[name].values(contents), strict=True)
        return found

    def _learned(self, obs: Mapping[str, Array], stop: Stop) -> tuple[FrameWork, dict[str, list[Content]]]:
        """What was done for new rows, until ``stop`` said so; and the contents of all rows, by piece."""
        rows, work, known = self._rows_of(obs), FrameWork(), dict[str, list[Content]]()
        for name, piece in self._pieces.items():
            own, lanes = [rows[n] for n in piece.inputs], self._lanes_of(name, obs)
            known[name] = contents_of(own, lanes)
            work += self._memory[name].learn(known[name], self._compute(name, own, lanes), stop)
        return work, known

    def _rows_of(self, obs: Mapping[str, Array]) -> dict[str, Array]:
        if self._rows is None:
            return {}
        feed = {name: np.ascontiguousarray(obs[name]) for name in self._rows.inputs}
        return dict(zip(self._rows.outputs, self._run(FRAMES, feed), strict=True))

    def _compute(self, name: str, rows: Sequence[Array], lanes: Sequence[Lane]) -> Compute:
        """What computes one of the rows, of each input of the piece ``[N, ...]``."""
        piece, tower = self._pieces[name], self._tokens.get(name)

        def compute(i: int) -> tuple[tuple[Array, ...], FrameWork]:
            row = {n: each[i : i + 1] for n, each in zip(piece.inputs, rows, strict=True)}
            if tower is None:
                return self._run(name, row), FrameWork()
            values, computed, forward = tower.compute(lanes[i], row)
            return values, FrameWork(tokens=computed, forward=forward, of=tower.tokens)

        return compute

    def _lanes_of(self, name: str, obs: Mapping[str, Array]) -> Sequence[Lane]:
        """The lane of each row of a frame piece that reuses tokens: of frames of one camera of one stream the same.

        Rows are made by moving numbers. So if every camera of every stream shows one number, the rows tell which.
        """
        streams = len(next(iter(obs.values())))
        if name not in self._tokens or (name, streams) in self._lanes:
            return self._lanes.get((name, streams), ())
        shown = {}
        for i, (key, value) in enumerate(obs.items()):
            numbers = np.arange(i * streams, (i + 1) * streams) + 1
            shares = numbers / (len(obs) * streams + 1) if value.dtype.kind == "f" else numbers
            one = shares.astype(value.dtype).reshape(-1, *[1] * (value.ndim - 1))
            shown[key] = np.broadcast_to(one, value.shape)
        (own,) = (self._rows_of(shown)[n] for n in self._pieces[name].inputs)
        rows = [hashlib.sha256(row.tobytes()).digest() for row in own]
        integers = [value.dtype for value in obs.values() if value.dtype.kind in "iu"]
        if any(len(obs) * streams > np.iinfo(kind).max for kind in integers):  # they cannot hold the numbers
            rows = [str(i).encode() for i in range(len(own))]  # each row is a lane
        lanes = [b"%d " % streams + row for row in rows]  # of other numbers of streams, other lanes
        self._lanes[name, streams] = lanes
        return lanes


NO_FRAMES = FramePieces({}, lambda name, feed: ())
"""Of a backend that computes every frame in every call."""
