"""What the originals made, and how near to it the actions of a policy have to be."""

from pathlib import Path

import numpy as np
import torch

from tests.rounding import PROMISED
from ttscompile import PolicySpec

Arrays = dict[str, np.ndarray]


def golden(name: str) -> Arrays:
    """A file of ``golden/``."""
    with np.load(Path(__file__).parent / "golden" / f"{name}.npz") as numbers:
        return dict(numbers)


def as_seen(spec: PolicySpec, numbers: Arrays) -> dict[str, torch.Tensor]:
    """The observations among them, as the module takes them."""
    return {key: torch.from_numpy(each.normalized(numbers[key])) for key, each in spec.observations.items()}


def assert_actions(spec: PolicySpec, sample: torch.Tensor, expected: Arrays) -> None:
    """The chunk of a final sample is ``action_pred`` within what is promised, and what is executed of it ``action``."""
    actions = spec.chunk.unnormalized(sample.numpy())
    tolerance = PROMISED * np.ptp(expected["action_pred"])
    assert np.abs(actions - expected["action_pred"]).max() < tolerance
    executed = actions[:, spec.chunk.start : spec.chunk.stop]
    assert executed.shape == expected["action"].shape
    assert np.abs(executed - expected["action"]).max() < tolerance
