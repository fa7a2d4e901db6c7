"""Small checkpoints, built as the original saves them but with plain dictionaries for the configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import torch

from tests.once import Once
from ttscompile.policies.networks.transformer_for_diffusion import TransformerConfig, TransformerForDiffusion

if TYPE_CHECKING:
    from .vlas import Array
    from .whole_vlas import Whole

HORIZON, TO, DO, DA = 6, 2, 5, 3

Payload = dict[str, Any]


def _config(as_cond: bool) -> dict[str, Any]:
    """A resolved configuration of a tiny policy."""
    channels = DA if as_cond else DA + DO
    return {
        "training": {"use_ema": True},
        "policy": {
            "_target_": "diffusion_policy.policy.diffusion_transformer_lowdim_policy.DiffusionTransformerLowdimPolicy",
            "model": {
                "_target_": "diffusion_policy.model.diffusion.transformer_for_diffusion.TransformerForDiffusion",
                "input_dim": channels,
                "output_dim": channels,
                "horizon": HORIZON,
                "n_obs_steps": TO,
                "cond_dim": DO if as_cond else 0,
                "n_layer": 1,
                "n_head": 2,
                "n_emb": 8,
                "p_drop_emb": 0.0,
                "p_drop_attn": 0.3,
                "causal_attn": True,
                "time_as_cond": True,
                "obs_as_cond": as_cond,
                "n_cond_layers": 0,
            },
            "noise_scheduler": {
                "_target_": "diffusers.schedulers.scheduling_ddpm.DDPMScheduler",
                "num_train_timesteps": 20,
                "beta_start": 0.0001,
                "beta_end": 0.02,
                "beta_schedule": "squaredcos_cap_v2",
                "variance_type": "fixed_small",
                "clip_sample": True,
                "prediction_type": "epsilon",
            },
            "horizon": HORIZON,
            "obs_dim": DO,
            "action_dim": DA,
            "n_action_steps": 3,
            "n_obs_steps": TO,
            "num_inference_steps": 20,
            "obs_as_cond": as_cond,
            "pred_action_steps_only": False,
        },
    }


def _weights(model: dict[str, Any], seed: int) -> dict[str, torch.Tensor]:
    """Random weights of the network, under the names and with the extras that the original saves."""
    torch.manual_seed(seed)
    sizes = {name: value for name, value in model.items() if name in TransformerConfig.__dataclass_fields__}
    sizes["n_obs_steps"] = sizes["n_obs_steps"] or HORIZON
    network = TransformerForDiffusion(TransformerConfig(**sizes))
    weights = {"_dummy_variable": torch.zeros(0), "model._dummy_variable": torch.zeros(0)}
    for key, value in network.state_dict().items():
        weights[f"model.{key}"] = value if "mask" in key else torch.randn(value.shape) * 0.3
    weights["mask_generator._dummy_variable"] = torch.zeros(0)
    for key, width in (("obs", DO), ("action", DA)):
        weights[f"normalizer.params_dict.{key}.scale"] = torch.linspace(0.5, 2.0, width)
        weights[f"normalizer.params_dict.{key}.offset"] = torch.linspace(-1.0, 1.0, width)
        weights[f"normalizer.params_dict.{key}.input_stats.max"] = torch.ones(width)
    return weights


@pytest.fixture
def payload() -> Callable[..., Payload]:
    """``payload(as_cond=True, **changes of cfg.policy.model)``: a checkpoint as it is before saving."""

    def build(as_cond: bool = True, **model: Any) -> Payload:
        config = _config(as_cond)
        config["policy"]["model"].update(model)
        states = {name: _weights(config["policy"]["model"], seed) for seed, name in enumerate(("model", "ema_model"))}
        return {"cfg": config, "state_dicts": states, "pickles": {"epoch": b"not even a pickle"}}

    return build


@pytest.fixture
def save(tmp_path: Path) -> Callable[[Payload], Path]:
    """Save a checkpoint; gives its path."""

    def write(payload: Payload) -> Path:
        path = tmp_path / "policy.ckpt"
        torch.save(payload, path)
        return path

    return write


@pytest.fixture(scope="module")
def whole(request: pytest.FixtureRequest) -> Whole:
    """The vision-language-action model that a file is about."""
    found: Whole = request.module.MODEL
    return found


@pytest.fixture(scope="module")
def golden(whole: Whole) -> Mapping[str, Array]:
    """The actions that lerobot gave."""
    return whole.golden()


@pytest.fixture(scope="module")
def compiled(whole: Whole, once: Once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The artifact of the first kind."""
    return whole.compiled(once, tmp_path_factory.mktemp("saved"))[0]


@pytest.fixture
def directory(whole: Whole, tmp_path: Path) -> Path:
    """A policy of the first kind, of the test's own."""
    return whole.save(whole.kinds[0], tmp_path, 0)
