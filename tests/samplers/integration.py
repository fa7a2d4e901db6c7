"""Integration of a velocity in float64: by definition, and by a table."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from ttscompile import SamplerTable

Array = npt.NDArray[np.float64]
Field = Callable[[Array, float], Array]


def velocity(x: Array, t: float) -> Array:
    """Not linear in the sample, and not in time."""
    return np.sin(2 * x) + np.cos(3 * t) - 0.3 * x * t


def by_table(table: SamplerTable, x: Array, field: Field) -> Array:
    """The formula of ``SamplerTable``, word by word, in float64."""
    memory = [np.zeros_like(x)] * table.memories
    for k in range(table.steps):
        out = field(x, float(table.timesteps[k]))
        row = {name: float(getattr(table, name)[k]) for name in table.COLUMNS}
        x0 = row["sample_to_x0"] * x + row["out_to_x0"] * out
        if table.clip is not None:
            x0 = np.clip(x0, -table.clip, table.clip)
        following = row["x0_to_next"] * x0 + row["sample_to_next"] * x + row["out_to_next"] * out
        following = following + sum(c * m for c, m in zip(table.memory_to_next[k], memory, strict=True))
        terms = [x0, x, out, *memory]
        memory = [sum((c * each for c, each in zip(of, terms, strict=True)), 0 * x) for of in table.to_memory[k]]
        x = following
    return x


def euler(x: Array, times: Array, field: Field) -> Array:
    for t, following in pairwise(times):
        x = x + (following - t) * field(x, t)
    return x


def rk4(x: Array, times: Array, field: Field) -> Array:
    for t, following in pairwise(times):
        h = following - t
        k1 = field(x, t)
        k2 = field(x + h / 2 * k1, t + h / 2)
        k3 = field(x + h / 2 * k2, t + h / 2)
        k4 = field(x + h * k3, t + h)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


NOISE = np.random.default_rng(0).standard_normal((3, 4, 2))
