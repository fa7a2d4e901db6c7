"""Diffusion Policy's transformers: configuration and weights to a denoiser.

The low-dimensional policy in all four variants of its network, and the one on images.

Source: ``DiffusionTransformerLowdimPolicy`` and ``DiffusionTransformerHybridImagePolicy`` of
real-stanford/diffusion_policy.
"""

from dataclasses import fields
from typing import Any

from torch import nn

from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser

from ..networks.transformer_for_diffusion import TransformerConfig, TransformerForDiffusion
from . import hybrid, parts
from .interpolation import Config
from .parts import Rebuilt, Saved, Weights

_NETWORK = "TransformerForDiffusion"
_SWITCHES = frozenset({"obs_as_cond", "pred_action_steps_only"})
_NETWORK_DEFAULTS = {"n_layer": 8, "n_cond_layers": 0, "n_head": 4, "n_emb": 256}
_NETWORK_DEFAULTS |= {"causal_attn": True, "time_as_cond": True}
_NETWORK_KEYS = frozenset({*_NETWORK_DEFAULTS, "p_drop_emb", "p_drop_attn"})
"""Settings of ``cfg.policy`` of the policy on images."""


def low_dim(saved: Saved) -> Rebuilt:
    """``DiffusionTransformerLowdimPolicy``."""
    network = _network(_network_config(saved.config), saved.weights)
    as_cond = saved.settings.flag("obs_as_cond", False)
    obs_dim, action_dim, n_obs_steps = saved.sizes("obs_dim", "action_dim", "n_obs_steps")
    module, sample, start, variant = _denoiser(saved, network, saved.weights, as_cond, obs_dim, action_dim)
    observations = {"obs": ObservationSpec((n_obs_steps, obs_dim), parts.affine(saved.weights, "obs", obs_dim))}
    known = _SWITCHES | {"obs_dim", "action_dim", "model"}
    return Rebuilt(module, observations, sample, action_dim, start, variant, known)


def on_images(saved: Saved) -> Rebuilt:
    """``DiffusionTransformerHybridImagePolicy``."""
    action_dim, observed = parts.read_shape_meta(saved.settings, "low_dim", "rgb")
    encoder = hybrid.build_encoder(saved.settings, observed, saved.weights)
    as_cond = saved.settings.flag("obs_as_cond", True)
    network = _network(_hybrid_config(saved, as_cond, action_dim, encoder.width), saved.weights)
    weights = parts.network_weights(saved.weights)
    module, sample, start, variant = _denoiser(saved, network, weights, as_cond, encoder.width, action_dim)
    observations = parts.observation_specs(observed, saved.settings.number("n_obs_steps"), saved.weights)
    known = _SWITCHES | hybrid.ENCODER_KEYS | _NETWORK_KEYS
    return Rebuilt(EncodedDenoiser(encoder, module), observations, sample, action_dim, start, variant, known)


def _network(config: TransformerConfig, weights: Weights) -> TransformerForDiffusion:
    """The network of a configuration, if the checkpoint has weights for one of its size."""
    width, tokens = config.n_emb, config.trunk_tokens
    channels = max(config.input_dim, config.output_dim, config.cond_dim)
    row = max(width, tokens if config.causal_attn else 0)  # of a position, or of a causal mask
    needed = {
        "n_emb": width * width,
        "input_dim, output_dim or cond_dim": width * channels,
        "horizon": row * tokens,
        "n_obs_steps": row * config.memory_tokens,
        "n_layer or n_cond_layers": max(config.n_layer, config.n_cond_layers) * width,
    }
    parts.require_room(needed, weights)
    return TransformerForDiffusion(config)


def _denoiser(
    saved: Saved, network: TransformerForDiffusion, weights: Weights, as_cond: bool, obs_dim: int, action_dim: int
) -> tuple[nn.Module, tuple[int, int], int, str]:
    """The network with its weights, as it is given the observation; ``(T, D)``, first executed step and variant."""
    horizon, start, variant = _check(saved, network.config, as_cond, obs_dim, action_dim)
    parts.load_network(network, weights)
    sample = (horizon, network.config.input_dim)
    if as_cond:
        return parts.TokensDenoiser(network), sample, start, variant
    n_obs_steps = saved.settings.number("n_obs_steps")
    return parts.InpaintingDenoiser(network, sample, action_dim, n_obs_steps), sample, start, variant


def _network_config(config: Config) -> TransformerConfig:
    """``cfg.policy.model`` as a record; what is absent has the original's default."""
    names = [field.name for field in fields(TransformerConfig)]
    # obs_as_cond is taken from cond_dim by the original; dropout does nothing at inference.
    values = parts.network_settings(config, _NETWORK, {*names, "obs_as_cond", "p_drop_emb", "p_drop_attn"})
    if values.get("n_obs_steps") is None:
        values["n_obs_steps"] = values.get("horizon")
    for name in ("input_dim", "output_dim", "horizon"):
        if values.get(name) is None:
            raise CheckpointError(f"cfg.policy.model.{name} is missing; it is needed to rebuild the network.")
    return TransformerConfig(**{name: values[name] for name in names if name in values})


def _hybrid_config(saved: Saved, as_cond: bool, action_dim: int, encoded: int) -> TransformerConfig:
    """The transformer's sizes, which this policy has among its own settings; the encoder gives ``encoded`` channels."""
    channels = action_dim + (0 if as_cond else encoded)
    values: dict[str, Any] = {name: saved.policy.get(name, default) for name, default in _NETWORK_DEFAULTS.items()}
    values |= {name: saved.policy.get(name) for name in ("horizon", "n_obs_steps")}
    try:
        return TransformerConfig(input_dim=channels, output_dim=channels, cond_dim=encoded if as_cond else 0, **values)
    except CheckpointError as error:
        raise CheckpointError(str(error).replace("cfg.policy.model", "cfg.policy")) from error


def _check(
    saved: Saved, network: TransformerConfig, as_cond: bool, obs_dim: int, action_dim: int
) -> tuple[int, int, str]:
    """Check sizes against each other; gives T of the sample, the first executed step and the name of the variant."""
    only_steps = saved.settings.flag("pred_action_steps_only", False)
    full_horizon, n_action_steps, n_obs_steps = saved.sizes("horizon", "n_action_steps", "n_obs_steps")
    if only_steps and not as_cond:
        raise CheckpointError("cfg.policy.pred_action_steps_only needs obs_as_cond; the original refuses this, too.")
    horizon = n_action_steps if only_steps else full_horizon
    channels = action_dim + (0 if as_cond else obs_dim)
    expected = {"input_dim": channels, "output_dim": channels, "cond_dim": obs_dim if as_cond else 0}
    found = f"obs_as_cond = {as_cond}, action_dim = {action_dim} and obs_dim = {obs_dim}"
    parts.require_sizes(network, expected, found)
    exact = network.causal_attn
    limits = {"horizon": (network.horizon, horizon)}
    if as_cond:
        limits["n_obs_steps"] = (network.n_obs_steps, n_obs_steps)
    for name, (room, used) in limits.items():
        if used > room or (exact and used != room):
            raise CheckpointError(
                f"cfg.policy.model.{name} is {room}, but the policy gives the network {used} tokens; expected"
                f" {'the same number, because causal masks have a fixed size' if exact else 'at most as many'}."
            )
    if not only_steps and n_obs_steps > horizon:
        raise CheckpointError(f"cfg.policy: n_obs_steps = {n_obs_steps} is longer than horizon = {horizon}.")
    start = 0 if only_steps else n_obs_steps - 1
    if not network.time_as_cond:
        return horizon, start, "encoder-only"
    if not network.cond_dim:
        return horizon, start, "inpainting"
    return horizon, start, f"{'transformer' if network.n_cond_layers else 'token-wise'} condition encoder"
