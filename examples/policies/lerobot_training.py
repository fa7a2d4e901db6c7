"""What recipes of lerobot's policies share: windows of demonstrations, statistics, batches, and what is saved.

Nothing here needs lerobot.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file


def window_indices(episode_ends: np.ndarray, frames: int, horizon: int, executed: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames of every window: the observations up to now, and the actions from the first of them on.

    The ends of an episode are repeated beyond it, as lerobot does. A window starts at every frame after which
    ``executed`` actions are left, at most one of them repeated.

    Returns:
        int64 ``[N, frames]`` and ``[N, horizon]``.
    """
    observed, acted = [], []
    for first, end in zip([0, *episode_ends[:-1]], episode_ends, strict=True):
        now = np.arange(first, max(first + 1, end - executed + 1))[:, None]
        observed.append(np.clip(now + np.arange(1 - frames, 1), first, end - 1))
        acted.append(np.clip(now + np.arange(1 - frames, 1 - frames + horizon), first, end - 1))
    return np.concatenate(observed), np.concatenate(acted)


def statistics(values: np.ndarray) -> dict[str, torch.Tensor]:
    """What lerobot's normalisers want to know of a feature, over ``[N, D]``."""
    found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    return {name: torch.as_tensor(value, dtype=torch.float32) for name, value in found.items()}


def draw(windows: dict[str, torch.Tensor], size: int, seed: int) -> Iterator[dict[str, torch.Tensor]]:
    """Batches without end, every epoch in an order of its own."""
    generator, count = np.random.default_rng(seed), len(windows["action"])
    while True:
        order = torch.from_numpy(generator.permutation(count))
        for chosen in order.split(size)[: count // size]:
            yield {name: every[chosen] for name, every in windows.items()}


def average(average: torch.Tensor, now: torch.Tensor, count: torch.Tensor | int) -> torch.Tensor:
    """Exponential average whose memory grows with the number of steps, up to 1000 of them."""
    keep = min(0.999, 1 - (1 + float(count)) ** -0.75)
    return average.lerp(now, 1 - keep)


@contextmanager
def saving(folder: Path) -> Iterator[Path]:
    """A folder to save a policy into, which then takes the other's place at once, its weights in half precision."""
    beside = folder.with_name(f".{folder.name}.new")
    shutil.rmtree(beside, ignore_errors=True)
    yield beside
    weights = load_file(beside / "model.safetensors")
    save_file({name: value.half() for name, value in weights.items()}, beside / "model.safetensors", {"format": "pt"})
    shutil.rmtree(folder, ignore_errors=True)
    beside.rename(folder)
