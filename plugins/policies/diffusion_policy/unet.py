"""Diffusion Policy's U-Nets: configuration and weights to a denoiser.

Source: ``DiffusionUnetLowdimPolicy``, ``DiffusionUnetHybridImagePolicy`` and ``DiffusionUnetImagePolicy`` of
real-stanford/diffusion_policy.
"""

from collections.abc import Collection, Mapping
from typing import Any, Literal

from torch import nn

from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.settings import Settings

from ..networks.conditional_unet1d import ConditionalUnet1D, UNetConfig
from . import parts
from .hybrid import ENCODER_KEYS, build_encoder as build_robomimic_encoder
from .images import build_encoder as build_image_encoder, encoder_settings
from .parts import Observed, Rebuilt, Saved, Weights

_NETWORK = "ConditionalUnet1D"
_SETTINGS = frozenset({"input_dim", "local_cond_dim", "global_cond_dim", "diffusion_step_embed_dim", "down_dims"})
_SETTINGS |= {"kernel_size", "n_groups", "cond_predict_scale"}
_SWITCHES = ("obs_as_global_cond", "obs_as_local_cond", "pred_action_steps_only", "oa_step_convention")
DEFAULTS: Mapping[str, Any] = {
    "diffusion_step_embed_dim": 256,
    "down_dims": [256, 512, 1024],
    "kernel_size": 5,
    "n_groups": 8,
}
"""Of the policies behind an encoder, which are not those of the network."""
MOST_STEPS = 4096
"""Of a chunk, which the weights do not limit; in use are 4 to 64."""

Given = Literal["global condition", "local condition", "inpainting"]
"""How the network is given the observation."""


def low_dim(saved: Saved) -> Rebuilt:
    """``DiffusionUnetLowdimPolicy``."""
    settings = saved.settings
    as_global, as_local, only_steps, from_last = (settings.flag(name, False) for name in _SWITCHES)
    if as_global and as_local:
        raise settings.error("obs_as_global_cond and obs_as_local_cond are both true; the original refuses this, too")
    if only_steps and not as_global:
        raise settings.error("pred_action_steps_only needs obs_as_global_cond; the original refuses this, too")
    given: Given = "global condition" if as_global else "local condition" if as_local else "inpainting"
    obs_dim, action_dim, n_obs_steps = saved.sizes("obs_dim", "action_dim", "n_obs_steps")
    network = parts.network_settings(saved.config, _NETWORK, _SETTINGS)
    if network.get("input_dim") is None:
        raise CheckpointError("cfg.policy.model.input_dim is missing; it is needed to rebuild the network.")
    config = UNetConfig(**{name: value for name, value in network.items() if name in _SETTINGS})
    expected = {
        "input_dim": action_dim + (obs_dim if given == "inpainting" else 0),
        "global_cond_dim": obs_dim * n_obs_steps if as_global else None,
        "local_cond_dim": obs_dim if as_local else None,
    }
    sizes = f"action_dim = {action_dim}, obs_dim = {obs_dim} and n_obs_steps = {n_obs_steps}"
    parts.require_sizes(config, expected, f"the observation as {given}, {sizes}")
    steps = "n_action_steps" if only_steps else "horizon"
    start = 0 if only_steps else n_obs_steps - from_last
    module, sample = denoiser(saved, saved.weights, config, given, action_dim, steps, start)
    return Rebuilt(
        module,
        {"obs": ObservationSpec((n_obs_steps, obs_dim), parts.affine(saved.weights, "obs", obs_dim))},
        sample,
        action_dim,
        start,
        given,
        frozenset({*_SWITCHES, "obs_dim", "action_dim", "model"}),
    )


def hybrid(saved: Saved) -> Rebuilt:
    """``DiffusionUnetHybridImagePolicy``."""
    action_dim, observed = parts.read_shape_meta(saved.settings, "low_dim", "rgb")
    encoder = build_robomimic_encoder(saved.settings, observed, saved.weights)
    return _on_images(saved, encoder, encoder.width, observed, action_dim, ENCODER_KEYS)


def images(saved: Saved) -> Rebuilt:
    """``DiffusionUnetImagePolicy``."""
    action_dim, _ = parts.read_shape_meta(saved.settings, "low_dim", "rgb")
    settings = encoder_settings(saved.settings)
    _, observed = parts.read_shape_meta(settings, "low_dim", "rgb")
    encoder = build_image_encoder(settings, observed, saved.weights)
    return _on_images(saved, encoder, encoder.width, observed, action_dim, {"shape_meta", "obs_encoder"})


def _on_images(
    saved: Saved, encoder: nn.Module, width: int, observed: Observed, action_dim: int, known: Collection[str]
) -> Rebuilt:
    defaults = {**DEFAULTS, "cond_predict_scale": True}
    network = {name: saved.policy.get(name, default) for name, default in defaults.items()}
    return behind_encoder(saved, encoder, width, observed, action_dim, network, {*known, *defaults})


def behind_encoder(
    saved: Saved,
    encoder: nn.Module,
    width: int,
    observed: Observed,
    action_dim: int,
    network: Mapping[str, Any],
    known: Collection[str],
) -> Rebuilt:
    """A U-Net on what an encoder makes of the observed steps.

    Args:
        saved: the policy.
        encoder: observations by key to ``[B, To, width]``.
        width: of a step's features.
        observed: what it takes.
        action_dim: Da.
        network: settings of the U-Net, but for its channels.
        known: settings of ``cfg.policy`` that were read for encoder and network.
    """
    as_global = saved.settings.flag("obs_as_global_cond", True)
    n_obs_steps = saved.settings.number("n_obs_steps")
    config = UNetConfig(
        input_dim=action_dim + (0 if as_global else width),
        global_cond_dim=width * n_obs_steps if as_global else None,
        **network,
    )
    given: Given = "global condition" if as_global else "inpainting"
    start = n_obs_steps - 1
    module, sample = denoiser(saved, parts.network_weights(saved.weights), config, given, action_dim, "horizon", start)
    return Rebuilt(
        EncodedDenoiser(encoder, module),
        parts.observation_specs(observed, n_obs_steps, saved.weights),
        sample,
        action_dim,
        start,
        given,
        frozenset({"obs_as_global_cond", *known}),
    )


def denoiser(
    saved: Saved, weights: Weights, config: UNetConfig, given: Given, action_dim: int, steps: str, start: int
) -> tuple[nn.Module, tuple[int, int]]:
    """The network with its weights, as it is given the observation, and the shape ``(T, D)`` of its sample.

    Args:
        weights: of the policy, without those of an encoder.
        steps: name of the setting that says how many steps its sample has.
    """
    horizon, n_obs_steps = saved.settings.number(steps, most=MOST_STEPS), saved.settings.number("n_obs_steps")
    network = network_of(saved.settings, weights, config, horizon, steps)
    if start >= horizon or (given != "global condition" and n_obs_steps > horizon):
        raise saved.settings.error(f"n_obs_steps = {n_obs_steps} leaves nothing of {steps} = {horizon}")
    sample = (horizon, config.input_dim)
    if given == "inpainting":
        return parts.InpaintingDenoiser(network, sample, action_dim, n_obs_steps), sample
    return (parts.GlobalDenoiser if given == "global condition" else parts.LocalDenoiser)(network), sample


def network_of(settings: Settings, weights: Weights, config: UNetConfig, horizon: int, name: str) -> ConditionalUnet1D:
    """The U-Net with its weights.

    Args:
        settings: of the policy.
        horizon: steps of its sample, for which the weights set no limit.
        name: of the setting that says so.
    """
    if horizon % config.divisor:
        levels = len(config.down_dims)
        halves = f"a U-Net of {levels} levels halves the steps of its sample {levels - 1} times, and doubles them again"
        raise settings.error(f"{name} is {horizon}; expected a multiple of {config.divisor}, because {halves}")
    width, dims = config.diffusion_step_embed_dim, config.down_dims
    needed = {
        "input_dim": config.input_dim * dims[0],
        "local_cond_dim": (config.local_cond_dim or 0) * dims[0],
        "global_cond_dim": (config.global_cond_dim or 0) * dims[0],
        "diffusion_step_embed_dim": width * max(width, *dims),
        "down_dims or kernel_size": config.kernel_size * sum(n * n for n in dims),
    }
    parts.require_room(needed, weights)
    network = ConditionalUnet1D(config)
    parts.load_network(network, weights)
    return network
