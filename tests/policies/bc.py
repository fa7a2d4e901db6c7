"""Diffusion BC at tiny sizes: what a training saves, with weights that a seed gives, and what its policies observe.

``tests/families/golden/make_diffusion_bc.py`` gives the original the same.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.families.checks import Arrays, golden, part
from tests.families.weights import draw_weights
from ttscompile.policies.diffusion_bc import DiffusionBC, Sizes

STREAMS, EXTRA, SEED = 2, 3, 23

VARIANTS = {
    "image_mlp": Sizes(12, 1, 2, 16, 24, (1, 1), (3, 6), 50),
    "image_transformer": Sizes(12, 1, 2, 16, 0, (8, 2), (3, 6), 10),
    "state_mlp": Sizes(5, 1, 3, 16, 24, (1, 1), None, 10),
    "states_mlp": Sizes(5, 2, 3, 16, 24, (1, 1), None, 10),
    "states_transformer": Sizes(5, 2, 3, 16, 0, (8, 2), None, 10),
}
"""From images, from a state, and from the last state and the one before it."""


def weights(variant: str) -> dict[str, torch.Tensor]:
    """Those that the original's network is given, and their counts of batches."""
    own = DiffusionBC(VARIANTS[variant]).state_dict()
    return draw_weights({name: tuple(value.shape) for name, value in own.items() if counts(name) is False}, SEED)


def counts(name: str) -> bool:
    """Whether an entry is how many batches a norm has seen."""
    return name.endswith("num_batches_tracked")


def schedule(timesteps: int) -> dict[str, torch.Tensor]:
    """The buffers of ``ddpm_schedules(1e-4, 0.02, timesteps)``, as the golden file has them."""
    found = part(golden("diffusion_bc"), f"schedule{timesteps}")
    return {name: torch.from_numpy(value) for name, value in found.items()}


def observation(variant: str) -> Arrays:
    """Random ones."""
    key, spec = VARIANTS[variant].observed
    return {key: np.random.default_rng(24).random((STREAMS, *spec.shape), dtype=np.float32)}


def draws(variant: str) -> np.ndarray:
    """The noise of a call, one after the other, ``[K, streams, actions]``."""
    sizes = VARIANTS[variant]
    shape = (sizes.timesteps + EXTRA, STREAMS, sizes.actions)
    return np.random.default_rng(25).standard_normal(shape, dtype=np.float32)


def expected(variant: str) -> Arrays:
    """What the original gave."""
    return part(golden("diffusion_bc"), variant)


def save(path: Path, variant: str, wrapped: bool = False, **changes: Any) -> Path:
    """``torch.save(model.state_dict(), path)``; an entry that is None is left out."""
    named: dict[str, Any] = weights(variant) | schedule(VARIANTS[variant].timesteps)
    named |= {"nn_model.fc1.0.model.1.num_batches_tracked": torch.tensor(3)}
    named = {name: value for name, value in (named | changes).items() if value is not None}
    torch.save({"model": named, "epoch": 3} if wrapped else named, path)
    return path
