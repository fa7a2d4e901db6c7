"""UMI's policies on images: configuration and weights to a denoiser.

Each key of the observation has a number of observed steps of its own, and the whole prediction is the chunk.

Source: ``DiffusionUnetTimmPolicy`` and ``DiffusionTransformerTimmPolicy`` of
real-stanford/universal_manipulation_interface at d095ba9 (Chi et al., arXiv 2402.10329).
"""

from dataclasses import replace
from typing import Any

from torch import nn

from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.settings import Settings

from ..networks.conditional_unet1d import UNetConfig
from ..networks.transformer_for_action_diffusion import TransformerForActionDiffusion
from ..networks.transformer_for_diffusion import TransformerConfig
from . import parts, timm_encoder
from .parts import Rebuilt, Saved
from .timm_encoder import Encoder
from .unet import DEFAULTS, MOST_STEPS, network_of

_POLICY = {"shape_meta", "obs_encoder", "input_pertub"}
_UNET: dict[str, Any] = {**DEFAULTS, "cond_predict_scale": True}
_OF_UNET = {*_UNET, "obs_as_global_cond", "inpaint_fixed_action_prefix", "train_diffusion_n_samples"}
_TRANSFORMER = {"n_layer": 7, "n_head": 8, "n_emb": 768}


def unet(saved: Saved) -> Rebuilt:
    """``DiffusionUnetTimmPolicy``."""
    settings = saved.settings
    if not settings.flag("obs_as_global_cond", True):
        raise settings.refusal("obs_as_global_cond", "true; the original refuses this, too")
    encoder, horizon, action_dim = _observed(saved, "TimmObsEncoder")
    network = {name: saved.policy.get(name, default) for name, default in _UNET.items()}
    config = UNetConfig(input_dim=action_dim, global_cond_dim=encoder.width, **network)
    weights = parts.network_weights(saved.weights)
    denoiser = network_of(settings, weights, config, horizon, "shape_meta.action.horizon")
    made = _rebuilt(encoder, parts.GlobalDenoiser(denoiser), (horizon, action_dim), "global condition", _OF_UNET)
    # What is committed replaces the sample before every evaluation, as it is: of which the network is told nothing.
    return replace(made, prefix=horizon - 1 if settings.flag("inpaint_fixed_action_prefix", False) else 0)


def transformer(saved: Saved) -> Rebuilt:
    """``DiffusionTransformerTimmPolicy``."""
    encoder, horizon, action_dim = _observed(saved, "TransformerObsEncoder")
    sizes: dict[str, Any] = {name: saved.policy.get(name, default) for name, default in _TRANSFORMER.items()}
    sizes |= {"input_dim": action_dim, "output_dim": action_dim, "cond_dim": encoder.width}
    try:
        config = TransformerConfig(horizon=horizon, n_obs_steps=encoder.rows, **sizes)
    except CheckpointError as error:
        raise CheckpointError(str(error).replace("cfg.policy.model", "cfg.policy")) from error
    if config.n_emb != encoder.width:
        found = f"n_emb is {config.n_emb}, and that of its obs_encoder {encoder.width}"
        raise saved.settings.error(f"{found}; expected the same; the original refuses this, too")
    weights = parts.network_weights(saved.weights)
    needed = {
        "n_emb": config.n_emb**2,
        "shape_meta.action": config.n_emb * max(horizon, action_dim),
        "obs_encoder": config.n_emb * config.memory_tokens,
        "n_layer": config.n_layer * config.n_emb,
    }
    parts.require_room(needed, weights, "cfg.policy.")
    network = TransformerForActionDiffusion(config)
    parts.load_network(network, weights)
    known = {*_TRANSFORMER, "p_drop_attn"}
    return _rebuilt(encoder, parts.TokensDenoiser(network), (horizon, action_dim), "tokens", known)


def _observed(saved: Saved, name: str) -> tuple[Encoder, int, int]:
    """The encoder, and steps and numbers of the actions."""
    action_dim, _ = parts.read_shape_meta(saved.settings, "low_dim", "rgb")
    action: Settings = saved.settings.part("shape_meta").part("action")
    horizon = action.number("horizon", most=MOST_STEPS)
    return timm_encoder.build(saved.settings, name, saved.weights), horizon, action_dim


def _rebuilt(encoder: Encoder, denoiser: nn.Module, sample: tuple[int, int], variant: str, known: set[str]) -> Rebuilt:
    return Rebuilt(
        EncodedDenoiser(encoder.module, denoiser),
        encoder.observations,
        sample,
        sample[1],
        start=0,
        variant=variant,
        known=frozenset(_POLICY | known),
        executed=sample[0],
    )
