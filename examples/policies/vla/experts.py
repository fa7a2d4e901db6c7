"""Scripted experts for the twelve tasks of ``fetch_blocks``. What they do depends on what is there now alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from environments.fetch_blocks import COLOURS, HALF, REACH, TABLE, FetchBlocks

FloatArray = npt.NDArray[np.float64]

ABOVE, LOW = TABLE + 0.1, TABLE + 0.022
"""Heights of the grip, metres: where it passes over blocks, and where it pushes."""
BEHIND = 0.06
"""Metres between grip and block before a push."""


def _towards(offset: FloatArray, gain: float = 0.8, limit: float = 1.0) -> FloatArray:
    action = gain * np.asarray(offset) / REACH
    return action * min(1.0, limit / max(float(np.abs(action).max()), 1e-9))


def _over(grip: FloatArray, place: FloatArray) -> FloatArray:
    """Towards a place on the table, at a height where no block is hit."""
    offset = np.array([*(place[:2] - grip[:2]), ABOVE - grip[2]])
    if grip[2] < ABOVE - 0.03:
        offset[:2] *= 0.1
    return _towards(offset)


def act(world: FetchBlocks, task: str) -> npt.NDArray[np.float32]:
    """What the expert does now.

    Args:
        world: where everything is.
        task: one of ``TASKS``, whatever the episode's own is.

    Returns:
        float32 ``[4]`` of -1..1.
    """
    kind, *direction, colour = task.split()
    grip, block = world.grip, world.block(list(COLOURS).index(colour))
    offset = block - grip
    away = float(np.linalg.norm(offset[:2]))
    if kind == "touch":
        top = offset + np.array([0.0, 0.0, HALF])
        move = _towards(top) if away < 0.02 else _over(grip, block)
        return np.array([*move, -1.0], np.float32)
    if kind == "lift":
        if away > 0.04 or (away > 0.012 and grip[2] > LOW + 0.03):
            move, opening = _over(grip, block), 1.0
        elif abs(offset[2]) > 0.012:
            move, opening = _towards(offset), 1.0
        else:
            move, opening = _towards(offset), -1.0
            if world.opening < HALF + 0.004:
                move[2] = 0.8
        return np.array([*move, opening], np.float32)
    sign = 1.0 if direction == ["left"] else -1.0
    start = block - (0.0, sign * BEHIND, 0.0)
    along = sign * (grip[1] - block[1])
    if grip[2] < TABLE + 0.05 and abs(offset[0]) < 0.02 and -1.7 * BEHIND < along < -0.02:
        move = _towards(np.array([offset[0], 0.0, LOW - grip[2]]))
        move[1] = sign * 0.6
    elif np.linalg.norm(start[:2] - grip[:2]) < 0.018:
        move = _towards(np.array([*(start[:2] - grip[:2]), LOW - grip[2]]))
    else:
        move = _over(grip, start)
    return np.array([*move, -1.0], np.float32)
