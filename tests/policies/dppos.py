"""Checkpoints of DPPO with weights that a seed gives, so that golden files stay small.

``golden/make_dppo.py`` gives the original implementation the same weights, observations and noise.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import nn

from tests.families.checks import Arrays
from tests.families.weights import draw_weights
from ttscompile.policies.networks.dppo import DiffusionMLP, MLPConfig, Unet1D, UnetConfig

STREAMS, STEPS, WIDTH, HORIZON, ACTION = 2, 2, 5, 4, 3
_MLP = {"_target_": "model.diffusion.mlp_diffusion.DiffusionMLP", "horizon_steps": "${horizon_steps}"}
_UNET = {"_target_": "model.diffusion.unet.Unet1D", "diffusion_step_embed_dim": 8, "dim": 8, "kernel_size": 3}

VARIANTS: dict[str, dict[str, Any]] = {
    # As its authors train on states before they fine-tune.
    "mlp": {"network": {**_MLP, "time_dim": 8, "mlp_dims": [24, 24, 24], "residual_style": True}},
    # So many timesteps that the last of them show how the original rounds its schedule.
    "mlp_long": {"network": {**_MLP, "mlp_dims": [24]}, "model": {"denoising_steps": 100}},
    # The last three of eight steps are tuned; all that the network may have.
    "mlp_tuned": {
        "network": {**_MLP, "mlp_dims": [24, 16], "cond_mlp_dims": [16, 8], "activation_type": "ReLU"}
        | {"use_layernorm": True, "out_activation_type": "Identity"},
        "model": {"ft_denoising_steps": 3, "randn_clip_value": 3},
    },
    # DDIM, of whose four steps the last two are tuned; the deeper of the two encoders, which scales.
    "unet_tuned": {
        "network": {**_UNET, "dim_mults": [1, 2], "n_groups": 4, "cond_predict_scale": True, "groupnorm_eps": 1e-4},
        "model": {"ft_denoising_steps": 2, "use_ddim": True, "ddim_steps": 4, "denoising_steps": 20},
    },
    # Every step is tuned, so that one network is needed; it reads what an MLP makes of the state; the end is bounded.
    "unet": {
        "network": {**_UNET, "dim_mults": [1, 2, 3], "cond_mlp_dims": [16, 8], "activation_type": "ReLU"},
        "model": {"ft_denoising_steps": 4, "use_ddim": True, "ddim_steps": 4, "denoising_steps": 20}
        | {"denoised_clip_value": None, "final_action_clip_value": 0.6},
    },
}


def _tuned(variant: str) -> bool:
    return "ft_denoising_steps" in VARIANTS[variant].get("model", {})


def configuration(variant: str) -> dict[str, Any]:
    """``.hydra/config.yaml`` as hydra writes it, not resolved."""
    made, tuned = VARIANTS[variant], _tuned(variant)
    network = made["network"] | {"cond_dim": "${eval:'${obs_dim} * ${cond_steps}'}", "action_dim": "${action_dim}"}
    model = {
        "_target_": f"model.diffusion.{'diffusion_ppo.PPODiffusion' if tuned else 'diffusion.DiffusionModel'}",
        "network_path": "${base_policy_path}",
        "actor" if tuned else "network": network,
        "denoising_steps": 8,
        "min_sampling_denoising_std": 0.1,
        "device": "${device}",
    }
    model |= {name: f"${{{name}}}" for name in ("horizon_steps", "obs_dim", "action_dim")} | made.get("model", {})
    return {
        "logdir": "${oc.env:DPPO_LOG_DIR}/${now:%Y-%m-%d}",
        "base_policy_path": "${oc.env:DPPO_LOG_DIR}/state_8000.pt",
        "device": "cuda:0",
        "obs_dim": WIDTH,
        "action_dim": ACTION,
        "horizon_steps": HORIZON,
        "cond_steps": STEPS,
        "act_steps": 3,
        "model": model,
    }


def networks() -> dict[str, nn.Module]:
    """Of the variants, made here: for the names and shapes of their weights."""
    sample, seen = (HORIZON, ACTION), WIDTH * STEPS
    unet = {"actions": ACTION, "observed": seen, "time": 8, "kernel": 3}
    return {
        "mlp": DiffusionMLP(MLPConfig(sample, seen, 8, (24, 24, 24), (), "Mish", "Identity", False, True)),
        "mlp_long": DiffusionMLP(MLPConfig(sample, seen, 16, (24,), (), "Mish", "Identity", False, False)),
        "mlp_tuned": DiffusionMLP(MLPConfig(sample, seen, 16, (24, 16), (16, 8), "ReLU", "Identity", True, False)),
        "unet_tuned": Unet1D(
            UnetConfig(
                **unet, encoded=(), channels=(8, 16), groups=4, epsilon=1e-4, activation="Mish", deep=True, scales=True
            )
        ),
        "unet": Unet1D(
            UnetConfig(
                **unet,
                encoded=(16, 8),
                channels=(8, 16, 24),
                groups=None,
                epsilon=1e-5,
                activation="ReLU",
                deep=False,
                scales=False,
            )
        ),
    }


def payload(variant: str) -> dict[str, Any]:
    """What the training saves."""
    own = {name: tuple(value.shape) for name, value in networks()[variant].state_dict().items()}

    def of(prefix: str, seed: int) -> dict[str, torch.Tensor]:
        return {f"{prefix}.{name}": value for name, value in draw_weights(own, seed).items()}

    if not _tuned(variant):
        return {"epoch": 3, "model": of("network", 0), "ema": of("network", 1)}
    critic = {"critic.Q1.layers.0.weight": torch.zeros(3, 3)}
    return {"itr": 3, "model": of("network", 0) | of("actor", 0) | of("actor_ft", 2) | critic}


def normalization() -> dict[str, Any]:
    """``normalization.npz`` of the data set."""
    rows: dict[str, Any] = {name: np.linspace(low, low + 2, width) for name, low, width in _LOWEST}
    return rows | {name.replace("min", "max"): rows[name] + np.linspace(1, 3, len(rows[name])) for name in [*rows]}


_LOWEST = (("obs_min", -3.0, WIDTH), ("action_min", -1.0, ACTION))


def save(folder: Path, variant: str, normalized: bool = True, **changes: Any) -> Path:
    """A run as the training leaves it behind: the path of its checkpoint; ``changes`` are of the configuration."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / "checkpoint").mkdir()
    config = json.loads(json.dumps(configuration(variant)))
    for name, change in changes.items():
        config[name] = config.get(name, {}) | change if isinstance(change, dict) else change
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(config))
    if normalized:
        np.savez(folder / "normalization.npz", **normalization())
    torch.save(payload(variant), folder / "checkpoint" / "state_3.pt")
    return folder / "checkpoint" / "state_3.pt"


def observation() -> Arrays:
    """Raw states."""
    return {"state": np.random.RandomState(7).uniform(-3, 2, (STREAMS, STEPS, WIDTH)).astype(np.float32)}


def noise(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """``[B, T, D]`` and ``[K, B, T, D]``, none of the latter beyond what the original bounds."""
    rng = np.random.RandomState(11)
    shape = (STREAMS, HORIZON, ACTION)
    drawn = rng.standard_normal((steps, *shape)).astype(np.float32)
    return rng.standard_normal(shape).astype(np.float32), np.clip(drawn, -2.5, 2.5)
