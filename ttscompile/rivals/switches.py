"""Plans that depend on the observation: a few switches, each of which moves one computation to a better place.

A switch exchanges a computed cell of the schedule for a reused one when a linear function of the policy's condition
features says that this lowers the error of the call. The number of computed cells is the same whatever the switches
do, and the pruner's head (``passes/insert_pruner``) can express them exactly (``head_weights``). Which exchanges, and
when, follows from the linear models: they predict the effect of every exchange on every call. What an exchange is worth
is estimated on episodes that the function was not fitted on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..calibration.calls import Calls, IntArray
from ..core.lattice import BoolArray, PlanArray, Source
from ..ir.evaluate import Evaluator
from ..ir.graph import Graph, Ref, backward_slice
from ..ir.plan_head import NAMES
from .sensitivity import Matrix

COMPONENTS = 8
"""Principal components of the features that a switch can depend on."""

SHRINK = 0.5
"""Ridge penalty, as a share of the number of calls."""

FOLDS = 4

ENTERING = 300
"""Most promising reused cells that are examined as partners of each computed one."""

WORTH = 0.003
"""Share of the squared error by which another switch has to lower it."""


CODE, MARGIN, EDGE = 1.0, 64.0, 1e-3
"""Logits: what a switch moves; what no sum of switches moves; where a switch flips."""

STEEP = 30.0
"""Standard deviations of a switch's function become this much at the tanh: nearly always on or off."""


@dataclass(frozen=True)
class Switch:
    """Compute ``into`` in place of ``out`` where ``features @ weight + bias > 0``.

    Attributes:
        out: ``(k, b)`` of a computed cell of the schedule.
        into: ``(k, b)`` of a reused one.
        weight: ``[F]``.
    """

    out: tuple[int, int]
    into: tuple[int, int]
    weight: npt.NDArray[np.float64]
    bias: float

    @property
    def touched(self) -> frozenset[tuple[int, int]]:
        """Cells whose logits a head of rank one can move together with these two."""
        steps, blocks = {self.out[0], self.into[0]}, {self.out[1], self.into[1]}
        return frozenset((k, b) for k in steps for b in blocks)


class _Components:
    """Principal components of features, and ridge regression on them."""

    def __init__(self, features: Matrix, episodes: IntArray) -> None:
        self._mean = features.mean(0, dtype=np.float64)
        centred = features - self._mean
        _, sizes, rows = np.linalg.svd(centred, full_matrices=False)
        kept = min(COMPONENTS, len(features) // 8, int((sizes > 1e-6 * max(sizes[0], 1e-12)).sum()))
        deviation = sizes[:kept] / np.sqrt(len(features))
        self._whiten = rows[:kept].T / deviation
        self.scores = centred @ self._whiten
        self._folds = np.unique(episodes, return_inverse=True)[1] % FOLDS

    def out_of_fold(self) -> npt.NDArray[np.float64]:
        """``P [N, N]``: ``P @ y`` predicts y for each call from the episodes of other folds."""
        count = len(self.scores)
        predict = np.zeros((count, count))
        for fold in np.unique(self._folds):
            held, rest = np.flatnonzero(self._folds == fold), np.flatnonzero(self._folds != fold)
            if len(rest):
                design = np.column_stack([np.ones(len(held)), self.scores[held]])
                predict[np.ix_(held, rest)] = design @ self._solve(rest)
        return predict

    def function(self, target: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], float]:
        """Weight ``[F]`` and bias of the linear function of the features that fits ``target [N]``."""
        coefficients = self._solve(np.arange(len(self.scores))) @ target
        weight = self._whiten @ coefficients[1:]
        return weight, float(coefficients[0] - self._mean @ weight)

    def _solve(self, rows: IntArray) -> npt.NDArray[np.float64]:
        """``[1 + components, rows]``: from targets to coefficients."""
        design = np.column_stack([np.ones(len(rows)), self.scores[rows]])
        penalty = SHRINK * len(rows) * np.eye(design.shape[1])
        penalty[0, 0] = 0.0
        return np.asarray(np.linalg.solve(design.T @ design + penalty, design.T))


def fit_switches(
    effects: Matrix, error: Matrix, computed: BoolArray, features: Matrix, episodes: IntArray, count: int
) -> list[Switch]:
    """The most valuable switches, best first.

    Args:
        effects: ``[K, blocks, N, R]``, by how much the error of each call changes if a cell is toggled.
        error: ``[N, R]``, of the schedule.
        computed: ``[K, blocks]``, of the schedule.
        features: ``[N, F]``.
        episodes: ``[N]``, which episode each call is from.

    Returns:
        Switches that do not get into each other's way; none if the observation tells nothing.
    """
    components = _Components(features, episodes)
    if not components.scores.shape[1]:
        return []
    predict = components.out_of_fold()
    steps, blocks = computed.shape
    flat = effects.reshape(steps * blocks, *effects.shape[2:])
    leaving = blocks + np.flatnonzero(computed.reshape(-1)[blocks:])
    error = error.copy()
    total = float((error**2).sum())
    switches: list[Switch] = []
    while len(switches) < count and len(leaving):
        alone = 2 * np.einsum("cnr,nr->cn", flat, error) + (flat**2).sum(-1)
        entering = np.flatnonzero(~computed.reshape(-1))
        hope = np.minimum(alone[entering], 0).sum(1)
        entering = entering[np.argsort(hope, kind="stable")[:ENTERING]]
        crossed = np.einsum("inr,jnr->ijn", flat[leaving], flat[entering], optimize=True)
        gains = (alone[leaving][:, None] + alone[entering][None] + 2 * crossed).astype(np.float64)
        on = gains @ predict.T < 0
        worth = np.where(on, gains, 0.0).sum(-1)
        worth[_blocked(leaving, entering, steps, blocks, switches)] = np.inf
        i, j = np.unravel_index(np.argmin(worth), worth.shape)
        if not worth[i, j] < -WORTH * total:
            break
        out, into = int(leaving[i]), int(entering[j])
        weight, bias = components.function(-gains[i, j])
        switches.append(Switch(divmod(out, blocks), divmod(into, blocks), weight, bias))
        error = error + np.where(on[i, j][:, None], flat[out] + flat[into], 0)
    return switches


def _blocked(leaving: IntArray, entering: IntArray, steps: int, blocks: int, switches: list[Switch]) -> BoolArray:
    """Pairs that are not two separate effects, or get into the way of the switches that there are."""
    (k, b), (m, c) = np.divmod(leaving[:, None], blocks), np.divmod(entering[None], blocks)
    own, touched = np.zeros((2, steps, blocks), np.bool_)
    for switch in switches:
        own[tuple(zip(switch.out, switch.into, strict=True))] = True
        touched[tuple(zip(*switch.touched, strict=True))] = True
    blocked: BoolArray = (b == c) | touched[k, b] | touched[m, c] | own[k, c] | own[m, b]
    return blocked


def capacity(constants: Mapping[str, npt.NDArray[Any]]) -> int:
    """How many switches the head can hold: a direction and two hidden units each."""
    return min(int(constants["pruner.step"].shape[1]), int(constants["pruner.hidden.weight"].shape[0]) // 2)


def head_features(pruner: Graph, calls: Calls) -> Matrix:
    """What the head's first layer reads, ``[N, F]``."""
    layer = next(node for node in pruner.nodes if "pruner.hidden.weight" in node.refs())
    source = layer.args[0]
    assert isinstance(source, Ref)
    values = Evaluator(backward_slice(pruner, (source.name,), {}), {}, calls.device)(calls.contexts.condition)[0].cpu()
    return np.asarray(values.numpy(), dtype=np.float32)


def head_weights(
    constants: Mapping[str, npt.NDArray[Any]], schedule: PlanArray, switches: Sequence[Switch], features: Matrix
) -> dict[str, npt.NDArray[Any]]:
    """Constants with which the plan is the schedule, exchanged by the switches that are on.

    A linear function ``a`` passes the hidden layer exactly as ``gelu(a) - gelu(-a)``. The code of switch r is +1 or -1,
    nearly always; ``step[:, r]`` and ``block[r]`` carry it to the COMPUTE logits of its two cells, whose base is on the
    edge. All other cells have a margin that no sum of switches reaches.

    Args:
        constants: the pruner's constants as they are.
        schedule: ``[K, blocks]``.
        switches: the switches to express, at most ``capacity`` of them.
        features: ``[N, F]``, for the scale of the switches' functions.
    """
    new = {name: np.array(value) for name, value in constants.items()}
    for name in NAMES:
        new[name][...] = 0
    blocks = schedule.shape[1]
    np.put_along_axis(new["pruner.base"], schedule[..., None].astype(np.int64), MARGIN, axis=-1)
    by_block = new["pruner.block"].reshape(-1, blocks, len(Source))
    for r, switch in enumerate(switches):
        scale = float(np.std(features @ switch.weight)) or 1.0
        hidden = slice(2 * r, 2 * r + 2)
        new["pruner.hidden.weight"][hidden] = np.stack([switch.weight, -switch.weight]) / scale
        new["pruner.hidden.bias"][hidden] = np.array([switch.bias, -switch.bias]) / scale
        new["pruner.code.weight"][r, hidden] = [STEEP, -STEEP]
        (k, b), (m, c) = switch.out, switch.into
        new["pruner.step"][[k, m], r] = [-1, 1] if k != m else [1, 1]
        by_block[r, [b, c], Source.COMPUTE] = [CODE, CODE] if k != m else [-CODE, CODE]
        new["pruner.base"][k, b] = [EDGE, -MARGIN, 0, -MARGIN]
        new["pruner.base"][m, c] = [-EDGE, -MARGIN, 0, -MARGIN]
    return new
