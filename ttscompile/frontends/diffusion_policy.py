"""Diffusion Policy's transformers: checkpoint to module and ``PolicySpec``.

The low-dimensional policy in all four variants of its network, and the one on images, with DDPM and DDIM, as
real-stanford/diffusion_policy trains and saves them. The policy is rebuilt from configuration and weights; the packages
``diffusion_policy`` and ``robomimic`` are not needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from torch import nn

from ..core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ..errors import CheckpointError
from ..frontends import diffusion_policy_hybrid as hybrid
from .checkpoint import plain_config, read_checkpoint
from .diffusion_policy_weights import affine, build_network, choose_weights, load_network
from .encoded import EncodedDenoiser
from .families import LoadOptions
from .interpolation import Config
from .refusals import refuse_file, refuse_payload, refuse_policy
from .scheduler import configured_sampler
from .settings import Settings
from .transformer_for_diffusion import ConditionedDenoiser, InpaintingDenoiser, TransformerConfig

_POLICY = "DiffusionTransformerLowdimPolicy"
_NETWORK = "TransformerForDiffusion"
_SIZES = ("horizon", "obs_dim", "action_dim", "n_action_steps", "n_obs_steps")
_SWITCHES = ("obs_as_cond", "pred_action_steps_only")
_POLICY_KEYS = frozenset({*_SIZES, *_SWITCHES, "_target_", "model", "noise_scheduler", "num_inference_steps"})


def load(path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from a ``.ckpt``; see ``Family.load``.

    Source: ``predict_action`` of ``DiffusionTransformerLowdimPolicy`` and ``DiffusionTransformerHybridImagePolicy`` of
    real-stanford/diffusion_policy.
    """
    refuse_file(path)
    payload = read_checkpoint(path)
    try:
        return build(payload, options)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error


def build(payload: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Module and specification of what ``read_checkpoint`` gave; the rest as ``load``."""
    refuse_payload(payload)
    tree = plain_config(payload["cfg"])
    if not isinstance(tree, dict):
        raise CheckpointError(f"cfg is a {type(tree).__name__}; expected a dictionary.")
    config = Config(tree)
    name = str(config.require("policy._target_")).rpartition(".")[2]
    if name not in (_POLICY, hybrid.POLICY):
        refuse_policy(name)
    weights, which = choose_weights(payload["state_dicts"], config.get("training.use_ema"))
    policy = config.require("policy")
    encoder = None
    if name == hybrid.POLICY:
        action_dim, observed = hybrid.read_shape_meta(policy)
        encoder = hybrid.build_encoder(policy, observed, weights)
        policy |= {"obs_dim": encoder.width, "action_dim": action_dim}
        policy["obs_as_cond"] = policy.get("obs_as_cond", True)
        network = build_network(hybrid.network_config(policy, action_dim, encoder.width), weights)
        known = _POLICY_KEYS | hybrid.ENCODER_KEYS | hybrid.NETWORK_KEYS
    else:
        network = build_network(_network_config(config), weights)
        known = _POLICY_KEYS
    horizon, variant = _check_policy(policy, network.config)
    rest = {key: value for key, value in weights.items() if encoder is None or not key.startswith("obs_encoder.")}
    load_network(network, rest)

    obs_dim, action_dim, n_obs_steps = policy["obs_dim"], policy["action_dim"], policy["n_obs_steps"]
    module: nn.Module = ConditionedDenoiser(network)
    if not policy["obs_as_cond"]:
        module = InpaintingDenoiser(network, horizon, action_dim, n_obs_steps)
    if encoder is None:
        observations = {"obs": ObservationSpec((n_obs_steps, obs_dim), affine(weights, "obs", obs_dim))}
    else:
        module = EncodedDenoiser(encoder, module)
        observations = hybrid.observation_specs(observed, n_obs_steps, weights)
    start = 0 if policy["pred_action_steps_only"] else n_obs_steps - 1
    step_arguments = {key: policy[key] for key in policy if key not in known}
    scheduler, steps = policy["noise_scheduler"], policy.get("num_inference_steps")
    spec = PolicySpec(
        sample=(horizon, network.config.input_dim),
        observations=observations,
        sampler=configured_sampler(scheduler, steps, options, step_arguments=step_arguments),
        chunk=ChunkSpec(
            action_dim=action_dim,
            start=start,
            # The original slices action_pred[:, start : start + Ta], which ends with the horizon.
            stop=min(start + policy["n_action_steps"], horizon),
            normalizer=affine(weights, "action", action_dim),
        ),
        source={"format": "diffusion_policy", "policy": name, "variant": variant, "weights": which},
    )
    return module.eval(), spec


def _network_config(config: Config) -> TransformerConfig:
    """``cfg.policy.model`` as a record; what is absent has the original's default."""
    name = str(config.require("policy.model._target_")).rpartition(".")[2]
    if name != _NETWORK:
        raise CheckpointError(
            f"the policy's network is {name}; expected {_NETWORK}. Use ttscompile.compile_denoiser(module, spec)"
            " on a network of your own."
        )
    values = dict(config.require("policy.model"))
    if values.get("n_obs_steps") is None:
        values["n_obs_steps"] = values.get("horizon")
    names = [field.name for field in fields(TransformerConfig)]
    for name in ("input_dim", "output_dim", "horizon"):
        if values.get(name) is None:
            raise CheckpointError(f"cfg.policy.model.{name} is missing; it is needed to rebuild the network.")
    # obs_as_cond is taken from cond_dim by the original; dropout does nothing at inference.
    unknown = sorted(set(values) - {*names, "_target_", "obs_as_cond", "p_drop_emb", "p_drop_attn"})
    if unknown:
        raise CheckpointError(
            f"cfg.policy.model has settings that {_NETWORK} does not know: {', '.join(unknown)}. The network was"
            " changed; use ttscompile.compile_denoiser(module, spec)."
        )
    return TransformerConfig(**{name: values[name] for name in names if name in values})


def _check_policy(policy: dict[str, Any], network: TransformerConfig) -> tuple[int, str]:
    """Check sizes against each other and fill in defaults; gives T of the sample and the name of the variant."""
    settings = Settings(policy, "cfg.policy.")
    for name in _SWITCHES:
        policy[name] = settings.flag(name, False)
    if not isinstance(policy.get("noise_scheduler"), dict):
        raise CheckpointError("cfg.policy.noise_scheduler is missing; expected the settings of a diffusers scheduler.")
    for name in _SIZES:
        settings.number(name)

    as_cond, only_steps = policy["obs_as_cond"], policy["pred_action_steps_only"]
    if only_steps and not as_cond:
        raise CheckpointError("cfg.policy.pred_action_steps_only needs obs_as_cond; the original refuses this, too.")
    horizon = policy["n_action_steps"] if only_steps else policy["horizon"]
    channels = policy["action_dim"] + (0 if as_cond else policy["obs_dim"])
    expected = {"input_dim": channels, "output_dim": channels, "cond_dim": policy["obs_dim"] if as_cond else 0}
    for name, value in expected.items():
        if getattr(network, name) != value:
            raise CheckpointError(
                f"cfg.policy.model.{name} is {getattr(network, name)}; expected {value} with obs_as_cond = {as_cond},"
                f" action_dim = {policy['action_dim']} and obs_dim = {policy['obs_dim']}."
            )
    exact = network.causal_attn
    limits = {"horizon": (network.horizon, horizon)}
    if as_cond:
        limits["n_obs_steps"] = (network.n_obs_steps, policy["n_obs_steps"])
    for name, (room, used) in limits.items():
        if used > room or (exact and used != room):
            raise CheckpointError(
                f"cfg.policy.model.{name} is {room}, but the policy gives the network {used} tokens; expected"
                f" {'the same number, because causal masks have a fixed size' if exact else 'at most as many'}."
            )
    if not only_steps and policy["n_obs_steps"] > horizon:
        raise CheckpointError(f"cfg.policy: n_obs_steps = {policy['n_obs_steps']} is longer than horizon = {horizon}.")
    if not network.time_as_cond:
        return horizon, "encoder-only"
    if not network.cond_dim:
        return horizon, "inpainting"
    return horizon, f"{'transformer' if network.n_cond_layers else 'token-wise'} condition encoder"
