"""Weights of the pruner's head (``passes/insert_pruner``) that make it predict a given schedule with given switches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lattice import PlanArray, Source
from ...ir.evaluate import Evaluator
from ...ir.graph import Graph, Ref, backward_slice
from ..calls import Calls
from .linear import Matrix
from .switches import Switch

NAMES = frozenset(
    f"pruner.{n}" for n in ("hidden.weight", "hidden.bias", "code.weight", "code.bias", "step", "block", "base")
)

CODE, MARGIN, EDGE = 1.0, 64.0, 1e-3
"""Logits: what a switch moves; what no sum of switches moves; where a switch flips."""

STEEP = 30.0
"""Standard deviations of a switch's function become this much at the tanh: nearly always on or off."""


def has_head(constants: Mapping[str, Any]) -> bool:
    """Whether the pruner is the head that this module knows."""
    return set(constants) >= NAMES


def capacity(constants: Mapping[str, npt.NDArray[Any]]) -> int:
    """How many switches the head can hold: a direction and two hidden units each."""
    return min(int(constants["pruner.step"].shape[1]), int(constants["pruner.hidden.weight"].shape[0]) // 2)


def head_features(pruner: Graph, calls: Calls) -> Matrix:
    """What the head's first layer reads, ``[N, F]``."""
    layer = next(node for node in pruner.nodes if "pruner.hidden.weight" in node.refs())
    source = layer.args[0]
    assert isinstance(source, Ref)
    values = Evaluator(backward_slice(pruner, (source.name,), {}), {})(calls.contexts.condition)[0]
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
