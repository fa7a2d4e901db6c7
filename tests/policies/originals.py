"""What the originals made, and how near to it the actions of a policy have to be."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

import ttscompile
from tests.rounding import PROMISED, bound
from ttscompile import Noise, PolicySpec
from ttscompile.artifact import load_artifact
from ttscompile.runtimes import open_runtime

from ..runtimes.agreement import call_terms, largest_difference

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


def assert_compiled_acts(directory: Path, observation: Arrays, noise: Noise, expected: Arrays) -> None:
    """From raw observations to actions, through the artifact, in both runtimes; which agree on random plans, too."""
    for runtime in ("onnxruntime", "reference"):
        policy = ttscompile.load(directory, runtime=runtime)
        assert_same_actions(policy.predict_action(observation, noise=noise, plan="dense"), expected)
    assert_agreement_on_random_plans(directory, calls=3)


def assert_agreement_on_random_plans(compiled: Path, runtime: str = "onnxruntime", calls: int = 2) -> None:
    """Calls of two streams with random legal plans are the reference's, but for rounding."""
    artifact = load_artifact(compiled)
    runtimes = open_runtime(artifact, runtime), open_runtime(artifact, "reference")
    found = largest_difference(artifact, *runtimes, np.random.default_rng(3), streams=2, calls=calls)
    assert found < bound(call_terms(artifact))


def assert_same_actions(found: Mapping[str, np.ndarray], expected: Arrays) -> None:
    """What a compiled policy gives is the original's, within what is promised."""
    for name in ("action", "action_pred"):
        assert found[name].shape == expected[name].shape
        assert np.abs(found[name] - expected[name]).max() < PROMISED * np.ptp(expected["action_pred"])
