"""What was computed for a frame, by the frame's content: unchanged cameras and instructions cost nothing.

A frame is known by its bytes, never by its place or its time. So nothing stale can be read, whatever comes late, twice
or never: another frame has other bytes. Frames are computed one at a time, so that what is remembered has the very bits
that would be computed again.

A scene is what the frames of one stream decide together. It is known by what was computed for them, each result as the
object that it is, and by the bytes of the other observations that it reads. So no large arrays are compared.

Where tokens are reused, what is computed for a frame depends on the frames of its lane that were computed before it. It
is remembered for that lane alone; forgotten and computed again, it may have other numbers.
"""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import add
from types import MappingProxyType
from typing import TypeAlias, TypeVar

import numpy as np

from ttscompile.artifact.manifest import PieceRecord
from ttscompile.core.coercion import Array, Arrays
from ttscompile.ir.pieces import FRAMES, SCENE, frame_pieces

from .tokens import Lane, Run, Seen, TokenTower, TokenWork

Content: TypeAlias = "tuple[bytes | Lane | Result, ...]"
"""The bytes of one frame, of each input of the piece that reads it; before them its lane, if it has one. Of a scene the
results for its frames come first, after the lane."""
Rows = TypeVar("Rows", Array, "list[Result]")
Stop: TypeAlias = Callable[[], bool]
Compute: TypeAlias = Callable[[int], tuple[tuple[Array, ...], "FrameWork"]]
"""The number of a row to what a frame piece gives for it, ``[1, ...]`` each, and what was done for its tokens."""

WINDOWS = 2
"""How many calls' rows are remembered: those of the last one, and those that have come since."""


@dataclass(frozen=True)
class FrameWork:
    """What frame pieces and the scene did for a call.

    Attributes:
        computed: frames that were computed while the call waited.
        remembered: frames that were known.
        waited: ms that computing took.
        saved: ms that those remembered took when they were computed.
        tokens: that were computed of the frames and scenes that were.
        forward: that took the rows of a computed one (FORWARD). The others kept their own (ROLLOUT).
        of: how many tokens these have; 0 where tokens are not reused.
        by_camera: the same of each of these, and why so many were computed; the camera of a scene is ``scene``.
        scenes: that were computed while the call waited, one for each stream at most.
        scenes_remembered: that were known.
    """

    computed: int = 0
    remembered: int = 0
    waited: float = 0.0
    saved: float = 0.0
    tokens: int = 0
    forward: int = 0
    of: int = 0
    by_camera: tuple[TokenWork, ...] = ()
    scenes: int = 0
    scenes_remembered: int = 0

    def __add__(self, other: FrameWork) -> FrameWork:
        return FrameWork(*map(add, vars(self).values(), vars(other).values()))


@dataclass(frozen=True, eq=False)
class Result:
    """What was computed for a row, ``[1, ...]`` by output. It equals itself alone, whatever the numbers are."""

    values: tuple[Array, ...]
    took: float  # ms


class FrameMemory:
    """The rows of one frame piece, or the scenes, that were computed last."""

    def __init__(self) -> None:
        self._known: OrderedDict[Content, Result] = OrderedDict()

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
                work += FrameWork(remembered=1, saved=known.took)
                continue
            if stop():
                break
            start = time.perf_counter()
            values, done = compute(i)
            took = 1000.0 * (time.perf_counter() - start)
            # Where no token was computed the result is the object that it was.
            same = (one for one in self._known.values() if one.values is values)
            self._known[content] = next(same, Result(values, took))
            work += replace(done, computed=1, waited=took)
        while len(self._known) > WINDOWS * len(contents):
            self._known.popitem(last=False)
        return work

    def results(self, contents: Sequence[Content]) -> list[Result]:
        """What was computed for rows of these contents, which must be known."""
        return [self._known[content] for content in contents]

    def values(self, contents: Sequence[Content]) -> tuple[Array, ...]:
        """The same, of all rows together, ``[N, ...]`` each. Nobody may write to them."""
        found = [one.values for one in self.results(contents)]
        return tuple(each[0] if len(each) == 1 else np.concatenate(each) for each in zip(*found, strict=True))


def contents_of(rows: Sequence[Array], lanes: Sequence[Lane] = ()) -> list[Content]:
    """The content of each row, of the inputs of a piece ``[N, ...]``.

    Args:
        rows: of each input.
        lanes: of the rows, where what is given for one depends on the frames of its lane before it.
    """
    own = [[lane] for lane in lanes] or [[] for _ in rows[0]]
    return [(*lane, *(row.tobytes() for row in one)) for lane, *one in zip(own, *rows, strict=True)]


def _part(rows: Rows, number: int, count: int) -> Rows:
    """One of ``count`` equal parts."""
    size = len(rows) // count
    return rows[number * size : (number + 1) * size]


class FramePieces:
    """What depends on one frame alone, for the rows of all streams: only frames that are new are computed.

    So are scenes, one for each stream.

    Attributes:
        work: what the last ``values`` did.
    """

    def __init__(
        self, pieces: Mapping[str, PieceRecord], run: Run, tokens: Mapping[str, TokenTower] = MappingProxyType({})
    ) -> None:
        self._rows, self._run, self._tokens = pieces.get(FRAMES), run, tokens
        self._pieces = {name: pieces[name] for name in frame_pieces(pieces)}
        self._scene = pieces.get(SCENE)
        self._memory = {name: FrameMemory() for name in (*self._pieces, *{SCENE} & set(pieces))}
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

    def learn(self, obs: Arrays, stop: Stop = lambda: False) -> FrameWork:
        """Compute what is new in normalised observations ``[B, ...]``, until ``stop`` says so; no scene."""
        return self._learned(obs, stop)[0]

    def values(self, obs: Arrays) -> dict[str, Array]:
        """What the condition piece reads beside normalised observations ``[B, ...]``, and what the scene gives."""
        self.work, known = self._learned(obs, lambda: False)
        found = dict[str, Array]()
        for name, own in known.items():
            found |= zip(self._pieces[name].outputs, self._memory[name].values(own), strict=True)
        if (scene := self._scene) is None:
            return found
        streams, whole = len(next(iter(obs.values()))), {**obs, **found}
        shown = [self._memory[name].results(own) for name, own in known.items()]
        told = [obs[name] for name in scene.inputs if name in obs]
        lanes = [Lane(b"%d" % streams, SCENE, stream) for stream in range(streams)]
        kept = lanes if SCENE in self._tokens else ()  # what is kept of a stream is in its results
        contents: list[Content] = [
            (*kept[s : s + 1], *(n for rows in shown for n in _part(rows, s, streams)), *(n[s].tobytes() for n in told))
            for s in range(streams)
        ]
        rows = [np.ascontiguousarray(whole[name]) for name in scene.inputs]
        work = self._memory[SCENE].learn(contents, self._compute(SCENE, scene, rows, streams, lanes))
        done, before = work.computed, work.remembered
        self.work += replace(work, computed=0, remembered=0, scenes=done, scenes_remembered=before)
        return found | dict(zip(scene.outputs, self._memory[SCENE].values(contents), strict=True))

    def _learned(self, obs: Arrays, stop: Stop) -> tuple[FrameWork, dict[str, list[Content]]]:
        """What was done for new rows, until ``stop`` said so; and the contents of all rows, by piece."""
        rows, work, known = self._rows_of(obs), FrameWork(), dict[str, list[Content]]()
        for name, piece in self._pieces.items():
            own, lanes = [rows[n] for n in piece.inputs], self._lanes_of(name, obs)
            known[name] = contents_of(own, lanes)
            work += self._memory[name].learn(known[name], self._compute(name, piece, own, len(own[0]), lanes), stop)
        return work, known

    def _rows_of(self, obs: Arrays) -> dict[str, Array]:
        if self._rows is None:
            return {}
        feed = {name: np.ascontiguousarray(obs[name]) for name in self._rows.inputs}
        return dict(zip(self._rows.outputs, self._run(FRAMES, feed), strict=True))

    def _compute(
        self, name: str, piece: PieceRecord, rows: Sequence[Array], count: int, lanes: Sequence[Lane] = ()
    ) -> Compute:
        """What computes one of ``count`` rows, or all rows of one stream; they are of each input of the piece."""
        tower = self._tokens.get(name)

        def compute(i: int) -> tuple[tuple[Array, ...], FrameWork]:
            row = {n: _part(each, i, count) for n, each in zip(piece.inputs, rows, strict=True)}
            if tower is None:
                return self._run(name, row), FrameWork()
            values, done = tower.compute(lanes[i], row)
            return values, FrameWork(tokens=done.computed, forward=done.forward, of=done.of, by_camera=(done,))

        return compute

    def _lanes_of(self, name: str, obs: Arrays) -> Sequence[Lane]:
        """The lane of each row of a frame piece that reuses tokens: of frames of one camera of one stream the same.

        Rows are made by moving numbers. So if every camera of every stream shows one number, the rows tell which.
        """
        streams = len(next(iter(obs.values())))
        if name not in self._tokens or (name, streams) in self._lanes:
            return self._lanes.get((name, streams), ())
        shown, shows = {}, dict[float, tuple[str, int]]()
        for i, (key, value) in enumerate(obs.items()):
            numbers = np.arange(i * streams, (i + 1) * streams) + 1
            shares = numbers / (len(obs) * streams + 1) if value.dtype.kind == "f" else numbers
            one = shares.astype(value.dtype)
            shows = {number: (key, stream) for stream, number in enumerate(one.tolist())} | shows
            shown[key] = np.broadcast_to(one.reshape(-1, *[1] * (value.ndim - 1)), value.shape)
        (own,) = (self._rows_of(shown)[n] for n in self._pieces[name].inputs)
        rows = [Lane(hashlib.sha256(row.tobytes()).digest(), *_shown_by(row, shows)) for row in own]
        integers = [value.dtype for value in obs.values() if value.dtype.kind in "iu"]
        if any(len(obs) * streams > np.iinfo(kind).max for kind in integers):  # they cannot hold the numbers
            rows = [Lane(b"%d" % i) for i in range(len(own))]  # each row is a lane
        # Of other numbers of streams, other lanes.
        lanes = [row._replace(key=b"%d " % streams + row.key) for row in rows]
        self._lanes[name, streams] = lanes
        return lanes


def _shown_by(row: Array, shows: Mapping[float, tuple[str, int]]) -> tuple[str, int]:
    """The observations that a row is made of, and its stream, where each shows a number of its own."""
    found = [shows[number] for number in np.unique(row).tolist() if number in shows]
    return " and ".join(sorted({key for key, _ in found})), found[0][1] if found else 0


NO_FRAMES = FramePieces({}, lambda name, feed: ())
"""Of a backend that computes every frame in every call."""
