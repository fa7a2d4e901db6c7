"""The numbers that the plan head begins with: ``insert_pruner`` writes them, and training starts from them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

Parameters = dict[str, npt.NDArray[np.float32]]

SOURCES = 4
MASKED = -1e9
"""Logit of a source that is illegal in a cell whatever the caches hold."""


def first_numbers(inputs: int, width: int, rank: int, steps: int, blocks: int) -> Parameters:
    """Constants of the head by name: always the same, and with them the plan is dense."""
    draw = np.random.default_rng(0)

    def normal(*shape: int, scale: float) -> npt.NDArray[np.float32]:
        return (draw.standard_normal(shape) * scale).astype(np.float32)

    base = np.zeros((steps, blocks, SOURCES), np.float32)
    base[..., 0] = 4.0  # dense until calibrated: |tanh| <= 1 keeps the observation's part below this
    mask = np.zeros_like(base)
    mask[0, :, 1:] = MASKED
    return {
        "pruner.hidden.weight": normal(width, inputs, scale=inputs**-0.5),
        "pruner.hidden.bias": np.zeros(width, np.float32),
        "pruner.code.weight": normal(rank, width, scale=width**-0.5),
        "pruner.code.bias": np.zeros(rank, np.float32),
        "pruner.step": normal(steps, rank, scale=0.1),
        "pruner.block": normal(rank, blocks * SOURCES, scale=0.1),
        "pruner.base": base,
        "pruner.mask": mask,
    }


NAMES = frozenset(
    f"pruner.{n}" for n in ("hidden.weight", "hidden.bias", "code.weight", "code.bias", "step", "block", "base")
)


def has_head(constants: Mapping[str, Any]) -> bool:
    """Whether the pruner with these constants is the head that is known here."""
    return set(constants) >= NAMES
