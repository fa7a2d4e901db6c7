"""What reusing tokens means, literally: each value of a tower or scene is computed whole, and most of it thrown away.

In a value that has a row for each token, the rows of tokens that are not computed are those that it had when they were,
or those that a computed token has now. Which tokens these are is said patch by patch.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ttscompile.core.plan import TokenReuse
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import GETITEM, Graph, Ref
from ttscompile.ir.tokens import TokenStream, find_tokens

Array = npt.NDArray[np.float32]
EIGHTHS = (1, 2, 3, 4, 6, 8)
NEAR = 1e-6
"""Differences of pixels that are nearer than this may be ordered either way: they are rounded."""


class LiteralChoice:
    """Which tokens of a lane's frames are computed, and which have rows of a computed one.

    Args:
        reuse: of the plan.
        fixed: how many tokens have no patch; they come first.
        patch: height and width of one.
    """

    def __init__(self, reuse: TokenReuse, fixed: int, patch: tuple[int, int]) -> None:
        self.reuse, self.fixed, self.patch = reuse, fixed, patch
        self.shown = dict[int, Array]()  # by token, the patch that it was last computed for
        self.age = 0

    def require(self, pixels: Array, computed: Collection[int], similar: Mapping[int, int]) -> dict[str, int]:
        """Raise AssertionError unless just these may be computed for a frame ``[C, H, W]``; how many of them why."""
        (high, wide), (_, height, width) = self.patch, pixels.shape
        cut = [pixels[:, y : y + high, x : x + wide] for y in range(0, height, high) for x in range(0, width, wide)]
        new, whole = dict(enumerate(cut, self.fixed)), self.fixed + len(cut)
        why = "" if self.shown else "first"
        if self.shown and self.age + 1 == self.reuse.refresh:
            why = "refresh"
        if why:
            assert sorted(computed) == list(range(whole)) and not similar
            self.shown, self.age = new, 0
            return {why: whole}
        off = {token: np.abs(new[token] - self.shown[token]).mean(dtype=np.float64) for token in new}
        changed = {token for token in new if off[token] > self.reuse.threshold}
        self.age += 1
        if not changed:
            assert not computed and not similar
            return {}
        size = next(n for n in (-(-whole * eighths // 8) for eighths in EIGHTHS) if n >= self.fixed + len(changed))
        assert len(set(computed)) == len(computed) == size
        assert {*range(self.fixed), *changed} <= set(computed), "and the next most changed"
        left = set(new) - set(computed)
        assert min(off[token] for token in new if token in computed) >= max((off[t] for t in left), default=0) - NEAR
        self._require_similar(new, sorted(set(new) & set(computed)), [t for t in left if off[t] > 0], similar, size)
        self.shown |= {token: new[token] for token in new if token in computed}
        self.age = 0 if size == whole else self.age
        return {"changed": len(changed), "filled": size - len(changed)}

    def _require_similar(
        self,
        new: Mapping[int, Array],
        computed: Sequence[int],
        others: Sequence[int],
        similar: Mapping[int, int],
        most: int,
    ) -> None:
        """Those that gain most, of those whose nearest computed patch is nearer than what they were computed for."""

        def apart(one: Array, other: Array) -> float:
            return float(np.square(one - other).mean(dtype=np.float64))

        nearest = {token: min(apart(new[token], new[one]) for one in computed) for token in others}
        gain = {token: apart(new[token], self.shown[token]) - nearest[token] for token in others}
        assert set(similar) <= set(others) and set(similar.values()) <= set(computed) and len(similar) <= most
        for token, source in similar.items():
            assert apart(new[token], new[source]) <= nearest[token] + NEAR and gain[token] > -NEAR
        least = min((gain[token] for token in similar), default=0.0) if len(similar) == most else 0.0
        assert all(gain[token] <= least + NEAR for token in others if token not in similar)


class LiteralSceneChoice:
    """Which tokens of a lane's scenes are computed: of a sequence of rows, some of which are words.

    Args:
        reuse: of the plan, with a share for scenes.
        words: the tokens that no picture changes.
    """

    def __init__(self, reuse: TokenReuse, words: Collection[int]) -> None:
        self.reuse, self.words = reuse, set(words)
        self.shown = dict[int, Array]()  # by token, the row that it was last computed for
        self.told: object = None
        self.age = 0

    def require(self, rows: Array, told: object, computed: Collection[int]) -> dict[str, int]:
        """Raise AssertionError unless just these may be computed for rows ``[T, D]`` that say ``told``; and why."""
        share, new, why = self.reuse.scene, dict(enumerate(rows)), ""
        assert share is not None and len(set(computed)) == len(computed)
        if self.shown:
            why = "refresh" if self.age + 1 == self.reuse.refresh else ""
        if not self.shown or told != self.told:
            why = "first"
        self.told = told
        if why:
            assert sorted(computed) == sorted(new)
            self.shown, self.age = new, 0
            return {why: len(new)}
        self.age += 1
        off = {token: self._off(row, self.shown[token]) for token, row in new.items() if token not in self.words}
        changed = {token for token, much in off.items() if much > share}
        if not changed:
            assert not computed
            return {}
        always = self.words | changed
        size = next(n for n in (-(-len(new) * eighths // 8) for eighths in EIGHTHS) if n >= len(always))
        assert len(computed) == size
        assert always <= set(computed), "and the next most changed"
        left = [off[token] for token in off if token not in computed]
        assert min(off[token] for token in off if token in computed) >= max(left, default=0) - NEAR
        self.shown |= {token: new[token] for token in computed}
        self.age = 0 if size == len(new) else self.age
        return {"changed": len(changed), "filled": size - len(changed)}

    @staticmethod
    def _off(one: Array, other: Array) -> float:
        """By which share of its numbers a row differs from another one."""
        apart, size = (np.abs(each).mean(dtype=np.float64) for each in (one - other, other))
        return 0.0 if apart == 0 else float(apart / max(size, 1e-30))


class LiteralTokens:
    """A tower, or a scene, of one frame after the other.

    Args:
        tower: of a program.
        weights: of its constants.
        stream: its tokens; None for those of a tower.
    """

    def __init__(
        self, tower: Graph, weights: Mapping[str, npt.NDArray[np.generic]], stream: TokenStream | None = None
    ) -> None:
        found = stream or find_tokens(tower, weights)
        assert not isinstance(found, str)
        self.tower, self.stream = tower, found
        self.weights = {name: torch.from_numpy(np.array(weights[name])) for name in tower.constants}
        self.kept: dict[str, torch.Tensor] = {}

    def __call__(
        self,
        row: npt.NDArray[np.float32] | Mapping[str, npt.NDArray[Any]],
        computed: Sequence[int] | npt.NDArray[np.int64],
        similar: Mapping[int, int] | None = None,
    ) -> list[npt.NDArray[np.float32]]:
        """What the tower gives for a row ``[1, ...]``, of which these tokens are computed.

        Args:
            row: of its input, or of each by name.
            similar: by token that is not computed, one that is, whose rows it gets; of the others it keeps them.
        """
        rows = row if isinstance(row, Mapping) else dict.fromkeys(self.tower.inputs, row)
        values = {**self.weights, **{name: torch.from_numpy(rows[name]) for name in self.tower.inputs}}
        chosen = torch.zeros(self.stream.tokens, dtype=torch.bool)
        chosen[torch.as_tensor(computed)] = True
        taken = torch.arange(self.stream.tokens)
        for token, other in (similar or {}).items():
            chosen[token], taken[token] = True, other
        types, several = self.tower.types(), dict[str, Sequence[torch.Tensor]]()
        for node in self.tower.nodes:
            if node.op == GETITEM:
                source, place = node.args
                assert isinstance(source, Ref)
                assert isinstance(place, int)
                value = several[source.name][place]
            else:
                one = node.resized(lambda batch: batch.multiple)  # of a row
                alone = Graph({name: types[name] for name in node.refs()}, {}, (one,), (node.name,))
                (value,) = evaluate(alone, {}, values)
            if isinstance(value, list | tuple):  # each of which is masked where it is taken
                several[node.name] = value
                continue
            axis = self.stream.axes.get(node.name)
            if axis is not None and node.name in self.kept:
                mask = chosen.reshape(-1, *[1] * (value.ndim - axis - 1))
                value = torch.where(mask, value.index_select(axis, taken), self.kept[node.name])
            values[node.name] = self.kept[node.name] = value
        return [values[name].numpy() for name in self.tower.outputs]
