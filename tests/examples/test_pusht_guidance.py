"""Guidance to the chunk before: its weights, its gradient, and what a chunk is guided to."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import guidance
import numpy as np
import pytest
import torch
from guidance import WAYS, GuidedPolicy
from torch import nn

import ttscompile
from ttscompile.frontends.eager import eager_policy
from ttscompile.samplers.flow import flow_matching_table

T, D, K = 6, 2, 4
LEROBOTS = {  # RTCProcessor of lerobot 0.6.1: get_prefix_weights(2, 7, 9), and how much of an error it adds at 1 - time
    "lerobot": (
        [1.0, 1.0, 0.83333331, 0.66666663, 0.5, 0.33333334, 0.16666667],
        {0.0: 10.0, 0.3: 2.7619047, 0.9: 9.1111},
    ),
    "published": ([1.0, 1.0, 0.63094801, 0.36770603, 0.18877034, 0.07674575, 0.01759126], {0.0: 5.0, 0.3: 2.7619047}),
}


class Linear(nn.Module):
    """A velocity that is linear in the whole sample."""

    def __init__(self) -> None:
        super().__init__()
        weight = torch.randn(T * D, T * D, generator=torch.Generator().manual_seed(1)) / 4
        self.weight = nn.Parameter(weight)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return (sample.flatten(1) @ self.weight).reshape(sample.shape) + obs.mean() * timestep[:, None, None]


SPEC = ttscompile.PolicySpec(
    sample=(T, D),
    observations={"obs": ttscompile.ObservationSpec((3,))},
    sampler=flow_matching_table(K),
    chunk=ttscompile.ChunkSpec(action_dim=D, start=1, stop=4),
)
OBS = {"obs": np.ones((1, 3), np.float32)}


def noise(seed: int) -> ttscompile.Noise:
    return ttscompile.Noise(np.random.default_rng(seed).standard_normal((1, T, D), dtype=np.float32))


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Linear:
    made = Linear().eval()
    monkeypatch.setattr(guidance, "original_policy", lambda checkpoint, spec: (made, SPEC))
    monkeypatch.setattr(guidance, "load_artifact", lambda path: SimpleNamespace(manifest=SimpleNamespace(spec=SPEC)))
    return made


def guided(way: str) -> GuidedPolicy:
    return GuidedPolicy(Path("policy"), Path("compiled"), None, WAYS[way])


@pytest.mark.parametrize("way", WAYS)
def test_weights_are_lerobots(way: str) -> None:
    weights, strengths = LEROBOTS[way]
    np.testing.assert_allclose(WAYS[way].weights(2, 7)[:, 0], weights, atol=1e-6)
    for signal, strength in strengths.items():
        assert WAYS[way].strength(signal, 1 - signal) == pytest.approx(strength, rel=1e-4)


@pytest.mark.parametrize("way", WAYS)
def test_without_a_chunk_before_it_is_the_policy(way: str, module: Linear) -> None:
    policy, plain = guided(way), eager_policy(module, SPEC)
    expected = plain({"obs": torch.ones(1, 3)}, noise(0)).detach().numpy()
    prefix = np.zeros((1, 2, D), np.float32)
    for given in (None, prefix):  # after a reset nothing is left of a chunk that the prefix could be of
        policy.reset()
        out = policy.predict_action(OBS, noise(0), prefix=given)
        np.testing.assert_allclose(out["action_pred"], expected, atol=1e-5)
        assert out["action"].shape == (1, 3, D)
    found = policy.predict_action(OBS, noise(0), prefix=prefix)["action_pred"]
    np.testing.assert_allclose(found, expected, atol=1e-5, err_msg="zeros are not of the chunk before")


@pytest.mark.parametrize("way", WAYS)
def test_a_chunk_is_guided_to_what_is_left_of_the_one_before(way: str, module: Linear) -> None:
    policy = guided(way)
    before = policy.predict_action(OBS, noise(0))["action_pred"][:, 1:]
    free = eager_policy(module, SPEC)({"obs": torch.ones(1, 3)}, noise(1)).detach().numpy()[:, 1:]
    made = policy.predict_action(OBS, noise(1), prefix=before[:, 2:4])["action_pred"][:, 1:]
    assert np.abs(made[:, :2] - before[:, 2:4]).mean() < 0.5 * np.abs(free[:, :2] - before[:, 2:4]).mean()


@pytest.mark.parametrize("way", WAYS)
def test_the_first_step_is_what_the_method_says(way: str, module: Linear, monkeypatch: pytest.MonkeyPatch) -> None:
    """With one step from noise: x + v + w J^T (W (left - x - v)), J = 1 + weight^T; without J for LeRobot's."""
    monkeypatch.setattr(guidance, "original_policy", lambda *_: (module, SPEC_OF_ONE_STEP))
    policy = guided(way)
    before = torch.from_numpy(policy.predict_action(OBS, noise(0))["action_pred"])[:, 1:]
    made = policy.predict_action(OBS, noise(1), prefix=before[:, 2:4].numpy())["action_pred"]
    sample = torch.from_numpy(noise(1).initial)
    velocity = (sample.flatten(1) @ module.weight).reshape(sample.shape)  # at time 0 nothing is added
    error = torch.zeros(1, T, D)
    error[:, 1:4] = (before[:, 2:] - (sample + velocity)[:, 1:4]) * WAYS[way].weights(2, 3)
    if WAYS[way].through:
        jacobian = torch.eye(T * D) + module.weight.T
        error = (error.flatten(1) @ jacobian).reshape(1, T, D)
    expected = sample + velocity + WAYS[way].largest * error
    np.testing.assert_allclose(made, expected.detach().numpy(), rtol=1e-4, atol=1e-4)


SPEC_OF_ONE_STEP: Any = ttscompile.PolicySpec(
    sample=(T, D), observations=SPEC.observations, sampler=flow_matching_table(1), chunk=SPEC.chunk
)


def test_another_sampler_is_refused(module: Linear, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        guidance,
        "original_policy",
        lambda *_: (
            module,
            ttscompile.PolicySpec(SPEC.sample, SPEC.observations, flow_matching_table(2, "rk4"), SPEC.chunk),
        ),
    )
    with pytest.raises(ValueError, match="guidance takes flow matching by Euler's method; found"):
        guided("published")
