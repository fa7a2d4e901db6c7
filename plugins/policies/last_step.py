"""What an original does to the sample after its loop, done at the loop's last step, which gives nothing but x0."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ttscompile.core.spec import SamplerTable
from ttscompile.errors import SpecError
from ttscompile.frontends.loops import Loops

_TOLERANCE = 1e-6
"""Of a coefficient that is 0 or 1 but for float32's rounding."""


def changed(loops: Loops, change: Callable[[SamplerTable], SamplerTable]) -> Loops:
    """The loops, each of them changed."""
    return Loops(change(loops.original), {name: change(one) for name, one in loops.others.items()}, loops.source)


def marked(table: SamplerTable) -> SamplerTable:
    """The table whose network is told of the last step: its timestep t is ``-1 - t``; ``unmarked`` reads it."""
    _require_x0(table)
    timesteps = table.timesteps.copy()
    timesteps[-1] = -1 - timesteps[-1]
    return replace(table, timesteps=timesteps)


def unmarked(timestep: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The timesteps as they were before ``marked``, and at which of them the loop ends, bool; both ``[B]``."""
    last = timestep < 0
    return torch.where(last, -1 - timestep, timestep), last


def clipped(table: SamplerTable, limit: float) -> SamplerTable:
    """The table that clips the last sample, and none before: a table's bound is for all x0 that are read as such."""
    _require_x0(table)
    x0, last = table.x0_to_next.astype(np.float64), np.arange(table.steps) == table.steps - 1
    to_memory, memory_to_next = table.to_memory.astype(np.float64), table.memory_to_next.copy()
    columns = {"x0_to_next": last.astype(np.float64), "noise_to_next": np.where(last, 0.0, table.noise_to_next)}
    for place, name in enumerate(("sample", "out"), start=1):
        meant = getattr(table, f"{name}_to_x0").astype(np.float64)
        columns[f"{name}_to_next"] = np.where(last, 0.0, getattr(table, f"{name}_to_next") + x0 * meant)
        to_memory[..., place] += to_memory[..., 0] * meant[:, None]
    to_memory[..., 0] = memory_to_next[-1] = 0
    found: Any = {name: column.astype(np.float32) for name, column in columns.items()}
    memories: Any = {"memory_to_next": memory_to_next, "to_memory": to_memory.astype(np.float32)}
    return replace(table, clip=limit, **found, **memories)


def _require_x0(table: SamplerTable) -> None:
    """Raise unless the last step gives the predicted sample, not clipped, and nothing beside."""
    x0 = table.x0_to_next[-1]
    beside = [table.noise_to_next[-1], *table.memory_to_next[-1]]
    for name in ("sample", "out"):
        meant = getattr(table, f"{name}_to_x0")[-1]
        beside.append(getattr(table, f"{name}_to_next")[-1] + x0 * meant - meant)
    if table.clip is not None or np.abs(beside).max() > _TOLERANCE:
        raise SpecError(
            f"sampler {table.name!r}: its last step gives something beside the clean sample that the network predicts."
            " Ask for ddpm, ddim or dpmsolver++ in another number of steps."
        )
