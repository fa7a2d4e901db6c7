"""Which cells to compute, as far as linear models of the error can tell: the best swaps, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ..lattice import BoolArray
from .linear import LinearModel, Matrix

LEAVING, ENTERING = 60, 300
"""Most promising cells of either kind whose pairs are examined."""

NEAR = 10
"""How far, in steps, a block's computation is tried to be moved with its effect on the cache taken exactly."""


@dataclass(frozen=True)
class _Change:
    """Cells that change between computed and reused, by how much the error changes, and its square."""

    cells: tuple[tuple[int, int], ...]
    effect: Matrix
    gain: float


class Trial:
    """Linear models of one plan, on which changes are tried.

    Args:
        models: of the same plan, of different calls.
    """

    def __init__(self, models: Sequence[LinearModel]) -> None:
        self._models = [replace(m) for m in models]

    @property
    def computed(self) -> BoolArray:
        """Cells that are computed."""
        return self._models[0].computed

    @property
    def error(self) -> Matrix:
        """Of all models."""
        return np.concatenate([m.error for m in self._models])

    def toggles(self) -> Matrix:
        """``[K, blocks, D]``, see ``LinearModel.toggles``."""
        return np.concatenate([m.toggles() for m in self._models], -1)

    def change(self, b: int, steps: npt.NDArray[np.int64]) -> Matrix:
        """``[D]``, see ``LinearModel.change``."""
        return np.concatenate([m.change(b, steps) for m in self._models])

    def apply(self, cells: Sequence[tuple[int, int]]) -> None:
        """Toggle these cells."""
        computed = self.computed.copy()
        for k, b in cells:
            computed[k, b] = not computed[k, b]
        for model in self._models:
            model.apply(computed)


def propose(models: Sequence[LinearModel], budget: int, changes: int) -> list[BoolArray]:
    """Plans after one, two, ... of the best changes.

    A change computes one cell more, as long as the budget allows; or computes one cell in place of another.

    Args:
        models: of the same plan.
        budget: computed cells, step 0 included.
        changes: how many at most.

    Returns:
        Computed cells ``[K, blocks]`` after each change; shorter than ``changes`` if nothing more is predicted to help.
    """
    trial = Trial(models)
    plans = []
    for _ in range(changes):
        best = _best(trial, budget)
        if best is None:
            break
        trial.apply(best.cells)
        plans.append(trial.computed.copy())
    return plans


def _best(trial: Trial, budget: int) -> _Change | None:
    """The change after which the squared error is predicted to be smallest; None if all increase it."""
    steps, blocks = trial.computed.shape
    error, effects = trial.error, trial.toggles().reshape(steps * blocks, -1)
    alone = 2 * effects @ error + np.einsum("cd,cd->c", effects, effects)
    computed = trial.computed.reshape(-1)
    entering = np.flatnonzero(~computed)
    entering = entering[np.argsort(alone[entering], kind="stable")[:ENTERING]]
    if computed.sum() < budget:
        first = entering[0]
        best = _Change((divmod(int(first), blocks),), effects[first], float(alone[first]))
    else:
        leaving = blocks + np.flatnonzero(computed[blocks:])
        if not len(leaving):
            return None
        leaving = leaving[np.argsort(alone[leaving], kind="stable")[:LEAVING]]
        pairs = alone[leaving][:, None] + alone[entering] + 2 * effects[leaving] @ effects[entering].T
        pairs[(leaving % blocks)[:, None] == entering % blocks] = np.inf  # one cache: not the sum of two effects
        i, j = np.unravel_index(np.argmin(pairs), pairs.shape)
        out, into = int(leaving[i]), int(entering[j])
        effect = effects[out] + effects[into]
        best = _Change((divmod(out, blocks), divmod(into, blocks)), effect, float(pairs[i, j]))
        moved = _best_move(trial, error)
        if moved is not None and moved.gain < best.gain:
            best = moved
    return best if best.gain < -1e-9 * float(error @ error) else None


def _best_move(trial: Trial, error: Matrix) -> _Change | None:
    """The best move of one block's computation to another step nearby."""
    best: _Change | None = None
    count, blocks = trial.computed.shape
    for b in range(blocks):
        steps = np.flatnonzero(trial.computed[:, b])
        for k in steps[1:]:
            kept = steps[steps != k]
            for target in range(max(1, k - NEAR), min(count, k + NEAR + 1)):
                if trial.computed[target, b]:
                    continue
                effect = trial.change(b, np.sort(np.append(kept, target)))
                gain = float(2 * effect @ error + effect @ effect)
                if best is None or gain < best.gain:
                    best = _Change(((int(k), b), (target, b)), effect, gain)
    return best
