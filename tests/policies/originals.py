"""What the originals made, and how near to it the actions of a policy have to be."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import nn

import ttscompile
from tests.rounding import PROMISED, Counted, assert_equal_but_for_rounding, bound
from ttscompile import Noise, PolicySpec
from ttscompile.artifact import load_artifact
from ttscompile.frontends.eager import eager_policy, evaluation
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


def assert_original(module: nn.Module, spec: PolicySpec, given: Arrays, noise: Noise, expected: Arrays) -> None:
    """Single evaluations, timesteps, and the actions of a whole call are those that the original gave.

    Args:
        given: the observation as it is recorded.
        noise: of the call; single evaluations are of the sample that it begins with.
        expected: the golden file.
    """
    observation = as_seen(spec, given)
    with torch.inference_mode():
        evaluate, sample = evaluation(module, spec, observation), torch.from_numpy(noise.initial)
        for timestep, prediction in zip(expected["probe_t"], expected["probe_out"], strict=True):
            with Counted() as counted:
                found = evaluate(sample, torch.full((len(sample),), int(timestep)))
            assert_equal_but_for_rounding(found, prediction, counted.terms, counted.angle)
    assert spec.sampler.timesteps.tolist() == expected["timesteps"].tolist()
    assert_actions(spec, eager_policy(module, spec)(observation, noise), expected)


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
