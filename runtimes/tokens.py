"""A tower, or the scene, computed for the tokens that changed: ``docs/design.md`` section 2, tokens.

What a token gave is kept by camera and stream of the batch, with the pixels that it was computed for. A new frame is
held against these pixels, not against the frame before, so that slow changes add up until they are seen. The pixels of
a scene are its sequence: a token's own row is its patch.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ttscompile.artifact.manifest import MANIFEST, Manifest
from ttscompile.artifact.strict_json import REMEDY
from ttscompile.core.coercion import Array, Arrays
from ttscompile.core.plan import TokenReuse
from ttscompile.errors import ArtifactError
from ttscompile.ir.pieces import INDEX, PIXELS, PLACES, ROWS, SCENE, pixels_name, tokens_name

Run: TypeAlias = Callable[[str, Arrays], tuple[Array, ...]]
"""A piece, by its name, on inputs by theirs; its outputs in order."""
Renew: TypeAlias = "Callable[[str, Arrays, Kept], tuple[Array, ...]]"
"""A piece for some tokens, by its name, on inputs by theirs, and what is kept, whose rows it renews where they are; its
other outputs in order."""


class Lane(NamedTuple):
    """One camera of one stream: its key, and the observations that show it; empty where they cannot be told apart."""

    key: bytes
    camera: str = ""
    stream: int = 0


EIGHTHS = (1, 2, 3, 4, 6)
"""A frame is computed for so many eighths of its tokens, or for all: few shapes, so that one was met before."""


_LEAST = np.float32(1e-12)
"""Added where something is divided by a sum that may be 0."""


def sizes_of(tokens: int) -> tuple[int, ...]:
    """For how many of a tower's tokens a frame may be computed, ascending."""
    return (*(-(-tokens * count // 8) for count in EIGHTHS), tokens)


@dataclass(frozen=True)
class TokenWork:
    """How many tokens were computed for a new frame, and why.

    Attributes:
        of: how many it has.
        first: since it is the first of its lane.
        refresh: since so many frames of the lane before it were not computed whole.
        changed: since their patches changed.
        filled: with these: those without a patch, and the next most changed, so that there are few shapes.
        forward: that took the rows of a computed one (FORWARD). The others kept their own (ROLLOUT).
        camera: the observations that show it.
        stream: of the batch.
    """

    of: int
    first: int = 0
    refresh: int = 0
    changed: int = 0
    filled: int = 0
    forward: int = 0
    camera: str = ""
    stream: int = 0

    @property
    def computed(self) -> int:
        """All that were computed."""
        return self.first + self.refresh + self.changed + self.filled


@dataclass(frozen=True)
class Seen:
    """What a policy sees of one camera.

    Attributes:
        pixels: ``[C, H, W]``, each patch as its token was last computed for.
        computed: bool ``[rows, columns]``, the patches whose tokens were computed for the newest frame.
        forward: bool ``[rows, columns]``, those whose tokens took the rows of a computed one.
        patch: height and width of a patch; pixels beyond the last one are in none.
        number: of this frame, new ones counted alone.
        work: how many tokens were computed for it, and why.
    """

    pixels: Array
    computed: Array
    forward: Array
    patch: tuple[int, int]
    number: int
    work: TokenWork


@dataclass
class Kept:
    """What is kept of a lane.

    Attributes:
        pixels: that each token was computed for, ``[C, H, W]``.
        arrays: rows ``[T, ...]`` by input of the piece.
        work: for the newest frame.
        index: of the tokens that were computed for it.
        forward: of those that took the rows of a computed one.
        told: what its row said in integers: the instruction of a scene.
        age: new frames since all tokens were computed.
        number: of the newest frame.
        bound: what ``renew`` has bound to the arrays, by how many rows each of its inputs has.
        shared: arrays that all of these have, by name: pixels, and what is made for all tokens.
    """

    pixels: Array
    arrays: dict[str, Array]
    values: tuple[Array, ...]
    work: TokenWork
    index: Array
    forward: Array
    told: bytes
    age: int = 0
    number: int = 0
    bound: dict[tuple[int, ...], Any] = field(default_factory=dict)
    shared: dict[str, Array] = field(default_factory=dict)


class TokenTower:
    """A frame piece, or the scene, that computes some of its tokens.

    Args:
        name: of the piece.
        run, renew: the piece that makes of a row what patches are cut from, and the piece for some tokens.
    """

    def __init__(self, name: str, manifest: Manifest, reuse: TokenReuse, run: Run, renew: Renew) -> None:
        self._pixels, self._part, self._scene = pixels_name(name), tokens_name(name), name == SCENE
        self._run, self._renew, self._record, self._reuse = run, renew, manifest.tokens[name], reuse
        self._cut, self._reads = (manifest.pieces[piece].inputs for piece in (self._pixels, self._part))
        self._threshold = reuse.scene if self._scene else reuse.threshold
        self._words = np.array(self._record.words, np.int64)
        self._always = np.concatenate([np.arange(self._record.fixed), self._words])
        self._free = np.setdiff1d(np.arange(self.tokens), self._always) - self._record.fixed
        # A picture may be of integers; and words that hold a state are others in every call (``Instruct.other_task``).
        words = manifest.spec.instruction
        self._told = self._scene and (words is None or words.state is None)
        self._lanes: dict[Lane, Kept] = {}

    @property
    def tokens(self) -> int:
        """T."""
        return self._record.tokens

    def forget(self) -> None:
        """Forget all lanes: the next frame of each is computed whole."""
        self._lanes.clear()

    def seen(self, lanes: Iterable[Lane]) -> Iterator[Seen]:
        """What is seen in those of the lanes that had a frame."""
        for kept in (self._lanes[lane] for lane in lanes if lane in self._lanes):
            _, rows, columns, *_ = self._patches(kept.pixels).shape
            numbers = self._record.fixed + np.arange(rows * columns).reshape(rows, columns)
            computed, forward = np.isin(numbers, kept.index), np.isin(numbers, kept.forward)
            yield Seen(kept.pixels.copy(), computed, forward, self._record.patch, kept.number, kept.work)

    def compute(self, lane: Lane, row: Arrays) -> tuple[tuple[Array, ...], TokenWork]:
        """What the piece gives for a new frame, a row ``[1, ...]`` by its inputs, and what was done.

        What is kept of the lane is gone if this fails. It is of no use where something else is said: all tokens of a
        scene have seen the words.

        Raises:
            ArtifactError: the manifest cuts the picture into other patches than there are tokens.
        """
        words = [one for one in row.values() if self._told and one.dtype.kind != "f"]
        kept, told = self._lanes.pop(lane, None), b"".join(one.tobytes() for one in words)
        if kept is not None and kept.told != told:
            kept = None
        (pixels,) = self._run(self._pixels, {name: row[name] for name in self._cut})
        if kept is None:
            self._require_patches(pixels[0])
        index, off, work = self._changed(kept, pixels[0], lane)
        if kept is None:
            nothing = {name: np.zeros(kind.at(1), kind.dtype) for name, kind in self._record.kept.items()}
            kept = Kept(pixels[0], nothing, (), work, index, index[:0], told)
        else:
            kept.age, kept.number, kept.forward = kept.age + 1, kept.number + 1, index[:0]
        if index.size:
            feed = {PIXELS: pixels, INDEX: index, **{n: row[n] for n in self._reads if n in row}}
            if PLACES in self._reads:  # an older artifact knows no FORWARD
                kept.forward, rows = self._similar(kept.pixels, pixels[0], index, off)
                feed |= _written(index, kept.forward, rows)
            kept.values = self._renew(self._part, feed, kept)
        if len(index) == self.tokens:
            kept.pixels, kept.age = pixels[0], 0
        elif index.size:
            theirs, ours = self._patches(kept.pixels), self._patches(pixels[0])
            y, x = np.divmod(index[self._record.fixed :] - self._record.fixed, ours.shape[2])
            theirs[:, y, x] = ours[:, y, x]
        kept.index, self._lanes[lane] = index, kept
        kept.work = replace(work, forward=len(kept.forward)) if len(kept.forward) else work
        return kept.values, kept.work

    def _changed(self, kept: Kept | None, pixels: Array, lane: Lane) -> tuple[Array, Array, TokenWork]:
        """Numbers of the tokens to compute, int64, none where no patch changed; how much each patch differs; and why.

        Of a frame that is computed whole anyway nobody asks how much differs, and nothing is said.
        """
        fixed, tokens, free = self._record.fixed, self.tokens, self._free
        work = partial(TokenWork, tokens, camera=lane.camera, stream=lane.stream)
        if kept is None or kept.age + 1 >= self._reuse.refresh:
            return np.arange(tokens), np.zeros(0, np.float32), work(refresh=tokens) if kept else work(first=tokens)
        off = self._differences(pixels, kept.pixels)
        changed = int(np.count_nonzero(off[free] > self._threshold))
        if not changed and not off[self._words].any():  # words may hold a state
            return np.arange(0), off, work()
        least = len(self._always)
        size = next((size for size in sizes_of(tokens) if size >= least + changed), tokens)
        index = np.arange(size)
        if size < tokens:
            most = np.argpartition(-off[free], size - least - 1)[: size - least]
            index = np.sort(np.concatenate([self._always, fixed + free[most]]))
        return index, off, work(changed=changed, filled=size - changed)

    def _similar(self, old: Array, new: Array, index: Array, off: Array) -> tuple[Array, Array]:
        """Tokens that take the rows of a computed one, and which one each takes, as a place in ``index``.

        Such a token is not computed, and its patch is nearer to that one's than to the pixels that it was last computed
        for. They are at most as many as are computed: those that gain most.
        """
        fixed, computed = self._record.fixed, index[self._record.fixed :] - self._record.fixed
        # The keys of a scene are turned by their place in the sequence: another token's are of another place.
        some = len(index) < self.tokens and not self._scene
        others = np.setdiff1d(off.nonzero()[0], computed, assume_unique=True) if some else index[:0]
        if not others.size:
            return others, others
        one, known = self._of(new, others), self._of(new, computed)
        # Half of the square of a difference, but for what is the same for all that a patch is held against.
        nearest = ((known * known).sum(1) / 2 - one @ known.T).argmin(1)
        gain = np.square(one - self._of(old, others)).mean(1) - np.square(one - known[nearest]).mean(1)
        best = np.argsort(-gain)[: len(index)]
        best = best[gain[best] > 0]
        return fixed + others[best], fixed + nearest[best]

    def _of(self, pixels: Array, patches: Array) -> Array:
        """Some patches of ``[C, H, W]``, a row each."""
        cut = self._patches(pixels)
        y, x = np.divmod(patches, cut.shape[2])
        return cut[:, y, x].swapaxes(0, 1).reshape(len(patches), -1)

    def _require_patches(self, pixels: Array) -> None:
        """Raise unless each token but the fixed ones has a patch: else the wrong ones would be computed."""
        _, rows, columns, *_ = self._patches(pixels).shape
        if self._record.fixed + rows * columns != self.tokens:
            raise ArtifactError(
                f"{MANIFEST}, tokens: expected a patch for each of {self.tokens - self._record.fixed} tokens; found"
                f" {rows} by {columns} patches of {self._record.patch} pixels. {REMEDY}"
            )

    def _differences(self, one: Array, other: Array) -> Array:
        """The mean absolute difference of each patch of ``[C, H, W]``, row by row; in a scene, of its numbers' mean."""
        high, wide = self._record.patch
        rows, columns = one.shape[1] // high, one.shape[2] // wide
        off = one[:, : rows * high, : columns * wide] - other[:, : rows * high, : columns * wide]
        np.abs(off, out=off)
        # Long rows first: a mean over all three axes at once takes twelve times as long.
        bands = off.reshape(len(off), rows, high, columns * wide).sum((0, 2))
        total: Array = bands.reshape(rows, columns, wide).sum(-1).ravel()
        # Features have no unit of their own, as pixels have.
        count = np.abs(other).sum((0, 2)) + _LEAST if self._scene else len(off) * high * wide
        return np.asarray(total / count)

    def _patches(self, pixels: Array) -> Array:
        """A view ``[C, rows, columns, height, width]`` of the patches of ``[C, H, W]``."""
        high, wide = self._record.patch
        rows, columns = pixels.shape[1] // high, pixels.shape[2] // wide
        cut = pixels[:, : rows * high, : columns * wide]
        return cut.reshape(len(cut), rows, high, columns, wide).swapaxes(2, 3)


def _written(index: Array, places: Array, rows: Array) -> dict[str, Array]:
    """Where rows go: those of computed tokens to their own places, and to ``places``.

    Two for each, so that shapes stay few: what is left over is written to its own place again. One for each where no
    other token takes any, since a whole frame takes longer with two; ``2*B`` is a name to onnxruntime.
    """
    own, left = np.arange(len(index)), len(index) - len(places) if len(places) else 0
    return {PLACES: np.concatenate([index, places, index[:left]]), ROWS: np.concatenate([own, rows, own[:left]])}


def token_towers(manifest: Manifest, reuse: TokenReuse | None, run: Run, renew: Renew) -> dict[str, TokenTower]:
    """By piece, those that reuse tokens; none where ``reuse`` is None."""
    if reuse is None:
        return {}
    return {name: TokenTower(name, manifest, reuse, run, renew) for name in reusing(manifest, reuse)}


def reusing(manifest: Manifest, reuse: TokenReuse | None) -> list[str]:
    """The pieces of which some tokens are computed, by name."""
    own = [] if reuse is None else list(manifest.tokens)
    return [name for name in own if name != SCENE or (reuse is not None and reuse.scene is not None)]
