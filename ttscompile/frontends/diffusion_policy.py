"""Diffusion Policy's low-dimensional transformer: checkpoint to module and ``PolicySpec``.

All four variants of the network, DDPM and DDIM, as real-stanford/diffusion_policy trains and saves them. The policy is
rebuilt from configuration and weights; the package ``diffusion_policy`` is not needed.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import torch
from torch import nn

from ..config import Affine, ChunkSpec, ObservationSpec, PolicySpec
from ..errors import CheckpointError
from .checkpoint import plain_config, read_checkpoint
from .interpolation import Config
from .scheduler import configured_sampler
from .transformer_for_diffusion import (
    ConditionedDenoiser,
    InpaintingDenoiser,
    TransformerConfig,
    TransformerForDiffusion,
)

_POLICY = "DiffusionTransformerLowdimPolicy"
_NETWORK = "TransformerForDiffusion"
_POLICY_KEYS = frozenset(
    {
        "_target_",
        "model",
        "noise_scheduler",
        "horizon",
        "obs_dim",
        "action_dim",
        "n_action_steps",
        "n_obs_steps",
        "num_inference_steps",
        "obs_as_cond",
        "pred_action_steps_only",
    }
)
_NORMALIZER_KEY = re.compile(r"normalizer\.params_dict\.\w+\.(scale|offset|input_stats\.\w+)")
_UNUSED_KEY = re.compile(r"(model\.)?_dummy_variable|mask_generator\..*")

Weights = Mapping[str, torch.Tensor]


def load_diffusion_policy(
    path: str | os.PathLike[str], sampler: str | None = None, steps: int | None = None, spacing: str | None = None
) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from a ``.ckpt``; arguments and errors as ``load_checkpoint_policy``.

    Source: ``DiffusionTransformerLowdimPolicy.predict_action`` of real-stanford/diffusion_policy.
    """
    payload = read_checkpoint(path)
    try:
        return _build(payload, sampler, steps, spacing)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error


def _build(
    payload: Mapping[str, Any], sampler: str | None, steps: int | None, spacing: str | None
) -> tuple[nn.Module, PolicySpec]:
    for part in ("cfg", "state_dicts"):
        if part not in payload:
            raise CheckpointError(
                f"no entry {part!r}; found {sorted(map(str, payload))[:8]}. Expected a checkpoint that Diffusion"
                " Policy's workspace saved: {cfg, state_dicts, pickles}."
            )
    tree = plain_config(payload["cfg"])
    if not isinstance(tree, dict):
        raise CheckpointError(f"cfg is a {type(tree).__name__}; expected a dictionary.")
    config = Config(tree)
    _require_supported(config)

    weights, which = _choose_weights(payload["state_dicts"], config.get("training.use_ema"))
    policy = config.require("policy")
    network = TransformerForDiffusion(_network_config(config))
    horizon, spec_variant = _check_policy(policy, network.config)
    _load_weights(network, weights)

    obs_dim, action_dim, n_obs_steps = policy["obs_dim"], policy["action_dim"], policy["n_obs_steps"]
    if policy["obs_as_cond"]:
        module: nn.Module = ConditionedDenoiser(network)
    else:
        module = InpaintingDenoiser(network, horizon, action_dim, n_obs_steps)
    start = 0 if policy["pred_action_steps_only"] else n_obs_steps - 1
    observation = ObservationSpec((n_obs_steps, obs_dim), _affine(weights, "obs", obs_dim))
    table = configured_sampler(
        policy["noise_scheduler"],
        policy["num_inference_steps"] if steps is None else steps,
        step_arguments={key: policy[key] for key in policy if key not in _POLICY_KEYS},
        sampler=sampler,
        spacing=spacing,
    )
    spec = PolicySpec(
        sample=(horizon, network.config.input_dim),
        observations={"obs": observation},
        sampler=table,
        chunk=ChunkSpec(
            action_dim=action_dim,
            start=start,
            # The original slices action_pred[:, start : start + Ta], which ends with the horizon.
            stop=min(start + policy["n_action_steps"], horizon),
            normalizer=_affine(weights, "action", action_dim),
        ),
        source={"format": "diffusion_policy", "policy": _POLICY, "variant": spec_variant, "weights": which},
    )
    return module.eval(), spec


def _require_supported(config: Config) -> None:
    """Refuse other policies by name, with what the user can do about it."""
    name = str(config.require("policy._target_")).rpartition(".")[2]
    if "unet" in name.lower():
        raise CheckpointError(
            f"the policy is {name}, a U-Net: its denoiser is not a transformer and has no residual stream whose blocks"
            f" could be reused. Expected {_POLICY}; train the transformer variant (the configurations named"
            " train_diffusion_transformer_*)."
        )
    if name == "DiffusionTransformerHybridImagePolicy":
        raise CheckpointError(
            f"the policy is {name}: its image encoder is not supported. Expected {_POLICY}. Compile the denoiser alone"
            " with ttscompile.compile_denoiser(policy.model, spec), with the encoder's features as its observation."
        )
    if name != _POLICY:
        raise CheckpointError(
            f"the policy is {name}; expected {_POLICY}. If it has a transformer denoiser, build it and use"
            " ttscompile.compile_denoiser(module, spec)."
        )
    network = str(config.require("policy.model._target_")).rpartition(".")[2]
    if network != _NETWORK:
        raise CheckpointError(
            f"the policy's network is {network}; expected {_NETWORK}. Use ttscompile.compile_denoiser(module, spec)"
            " on a network of your own."
        )


def _choose_weights(state_dicts: Any, use_ema: Any) -> tuple[Weights, str]:
    """The weights that the original's evaluation takes, and their name.

    Without ``use_ema`` in the configuration the averaged weights win, where there are any. Where the wanted ones are
    absent the others are taken with a warning.
    """
    if not isinstance(state_dicts, dict):
        raise CheckpointError(f"state_dicts is a {type(state_dicts).__name__}; expected a dictionary.")
    if use_ema not in (True, False, None):
        raise CheckpointError(f"cfg.training.use_ema is {use_ema!r}; expected true or false.")
    wanted, other = ("model", "ema_model") if use_ema is False else ("ema_model", "model")
    found = next((name for name in (wanted, other) if name in state_dicts), None)
    if found is None:
        raise CheckpointError(f"state_dicts holds {sorted(map(str, state_dicts))}; expected model or ema_model.")
    if found != wanted and use_ema is not None:
        warnings.warn(
            f"the configuration asks for the weights {wanted!r} (training.use_ema = {use_ema}), which the checkpoint"
            f" does not hold; using {found!r}.",
            stacklevel=2,
        )
    weights = state_dicts[found]
    if not isinstance(weights, dict):
        raise CheckpointError(f"state_dicts.{found} is a {type(weights).__name__}; expected a dictionary of tensors.")
    for key, value in weights.items():
        if not isinstance(value, torch.Tensor) or value.layout != torch.strided or not value.is_floating_point():
            what = f"{value.dtype} tensor" if isinstance(value, torch.Tensor) else type(value).__name__
            raise CheckpointError(f"weight {key} is a {what}; expected a dense floating-point tensor.")
    return {str(key): value.detach().to(torch.float32) for key, value in weights.items()}, found


def _network_config(config: Config) -> TransformerConfig:
    """``cfg.policy.model`` as a record; what is absent has the original's default."""
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
            f"cfg.policy.model has settings that {_NETWORK} does not know: {', '.join(unknown)}. The checkpoint comes"
            " from a changed network; use ttscompile.compile_denoiser(module, spec)."
        )
    return TransformerConfig(**{name: values[name] for name in names if name in values})


def _check_policy(policy: dict[str, Any], network: TransformerConfig) -> tuple[int, str]:
    """Check sizes against each other and fill in defaults; gives T of the sample and the name of the variant."""
    policy["obs_as_cond"] = policy.get("obs_as_cond", False)
    policy["pred_action_steps_only"] = policy.get("pred_action_steps_only", False)
    for name in ("obs_as_cond", "pred_action_steps_only"):
        if type(policy[name]) is not bool:
            raise CheckpointError(f"cfg.policy.{name} is {policy[name]!r}; expected true or false.")
    policy["num_inference_steps"] = policy.get("num_inference_steps")
    if not isinstance(policy.get("noise_scheduler"), dict):
        raise CheckpointError("cfg.policy.noise_scheduler is missing; expected the settings of a diffusers scheduler.")
    for name in ("horizon", "obs_dim", "action_dim", "n_action_steps", "n_obs_steps"):
        if type(policy.get(name)) is not int or policy[name] < 1:
            raise CheckpointError(f"cfg.policy.{name} is {policy.get(name)!r}; expected a positive whole number.")

    as_cond, only_steps = policy["obs_as_cond"], policy["pred_action_steps_only"]
    if only_steps and not as_cond:
        raise CheckpointError("cfg.policy.pred_action_steps_only needs obs_as_cond; the original refuses this, too.")
    horizon = policy["n_action_steps"] if only_steps else policy["horizon"]
    expected = {
        "input_dim": policy["action_dim"] + (0 if as_cond else policy["obs_dim"]),
        "output_dim": policy["action_dim"] + (0 if as_cond else policy["obs_dim"]),
        "cond_dim": policy["obs_dim"] if as_cond else 0,
    }
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
    return horizon, _variant(network)


def _variant(network: TransformerConfig) -> str:
    """What the network is, in the words of the README."""
    if not network.time_as_cond:
        return "encoder-only"
    if not network.cond_dim:
        return "inpainting"
    return "transformer condition encoder" if network.n_cond_layers else "token-wise condition encoder"


def _names(keys: list[str]) -> str:
    """A few names and how many more there are."""
    more = f" and {len(keys) - 6} more" if len(keys) > 6 else ""
    return ", ".join(keys[:6]) + more


def _load_weights(network: TransformerForDiffusion, weights: Weights) -> None:
    """Fill the network; every weight must be there, of the right shape, finite, and nothing else may be there."""
    expected = network.state_dict()
    found = {key.removeprefix("model."): value for key, value in weights.items() if key.startswith("model.")}
    found.pop("_dummy_variable", None)
    missing = [f"model.{key}" for key in expected if key not in found]
    extra = [f"model.{key}" for key in found if key not in expected]
    extra += [
        key
        for key in weights
        if not (key.startswith("model.") or _UNUSED_KEY.fullmatch(key) or _NORMALIZER_KEY.fullmatch(key))
    ]
    if missing or extra:
        parts = [f"missing {_names(missing)}"] * bool(missing) + [f"unexpected {_names(extra)}"] * bool(extra)
        raise CheckpointError(
            f"the weights do not fit the configuration: {'; '.join(parts)}. cfg.policy.model describes another network"
            " than the one that was saved, or the file is incomplete."
        )
    for key, value in found.items():
        if value.shape != expected[key].shape:
            raise CheckpointError(
                f"weight model.{key} has shape {tuple(value.shape)}; expected {tuple(expected[key].shape)} from"
                " cfg.policy.model."
            )
        if key in ("mask", "memory_mask"):
            if not torch.equal(value, expected[key]):
                raise CheckpointError(f"model.{key} is not the causal mask of {_NETWORK}; the network was changed.")
        elif not torch.isfinite(value).all():
            count = int((~torch.isfinite(value)).sum())
            raise CheckpointError(f"weight model.{key} holds {count} values that are not finite; training diverged.")
    network.load_state_dict(found, strict=True)


def _affine(weights: Weights, key: str, width: int) -> Affine:
    """The normaliser of one field, one entry a channel."""
    vectors = {}
    for name in ("scale", "offset"):
        full = f"normalizer.params_dict.{key}.{name}"
        if full not in weights:
            raise CheckpointError(f"the weights hold no {full}; the policy was saved before its normaliser was set.")
        vector = weights[full]
        if not torch.isfinite(vector).all() or (name == "scale" and (vector == 0).any()):
            raise CheckpointError(f"{full} is {vector.tolist()}; expected finite numbers, and no zero in a scale.")
        if vector.ndim != 1 or len(vector) not in (1, width):
            raise CheckpointError(
                f"{full} has shape {tuple(vector.shape)}; expected one entry for each of {width} channels."
            )
        # An identity normaliser has a single entry for all channels.
        vectors[name] = vector.expand(width).contiguous().numpy()
    return Affine(scale=vectors["scale"], offset=vectors["offset"])
