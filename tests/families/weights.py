"""Random weights by the names of parameters, and images, the same here and where the golden files were made."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch


def draw_weights(shapes: Mapping[str, Sequence[int]], seed: int) -> dict[str, torch.Tensor]:
    """Weights of a module; drawn in the order of their names, scaled so that values neither grow nor vanish.

    Args:
        shapes: of every parameter and buffer, by name.
        seed: of the generator.
    """
    rng = np.random.default_rng(seed)
    drawn = {}
    for key in sorted(shapes):
        noise = rng.standard_normal(tuple(shapes[key]), dtype=np.float32)
        if key.endswith("bias") or ("pos" in key and noise.ndim > 1):
            noise = noise * np.float32(0.1)
        elif noise.ndim == 1:
            noise = 1 + np.float32(0.1) * noise
        else:
            noise = noise / np.sqrt(np.float32(noise.shape[-1]))
        drawn[key] = torch.from_numpy(noise.astype(np.float32))
    return drawn


def uniform_images(streams: int, cameras: int, size: int, seed: int) -> np.ndarray:
    """Square images of 0..1, ``[streams, cameras, 3, size, size]``."""
    return np.random.default_rng(seed).random((streams, cameras, 3, size, size), dtype=np.float32)
