"""What every policy of Diffusion Policy has, whatever its network.

What was saved of it, settings and weights, the normalisers among them; what is rebuilt of that; and how its network is
given the observation: as tokens, as a vector, at its steps, or in the sample. Each of these modules is
``forward(sample, timestep, obs)`` as the compiler takes it, and as the denoiser of an ``EncodedDenoiser`` whose encoder
gives the features of each observed step.
"""

import re
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from ttscompile.core.spec import Affine, ObservationSpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.loops import Make
from ttscompile.frontends.saved_weights import as_float32, require_weights
from ttscompile.frontends.settings import Settings, is_shape

from .interpolation import Config

_OTHER_KEY = re.compile(
    r"(model\.)?_dummy_variable|mask_generator\..*|normalizer\.params_dict\.[^.]+\.(scale|offset|input_stats\.\w+)"
)
_MASKS = frozenset({"model.mask", "model.memory_mask"})
_COUNTERS = ".num_batches_tracked"  # of batch norm, whole numbers, used by training only

Weights = Mapping[str, torch.Tensor]


def choose_weights(state_dicts: Any, use_ema: Any) -> tuple[Weights, str]:
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
    return as_float32({key: value for key, value in weights.items() if not str(key).endswith(_COUNTERS)}), found


def require_room(needed: Mapping[str, int], weights: Weights, where: str = "cfg.policy.model.") -> None:
    """Raise unless the checkpoint has weights for a network of the configured sizes, before it is made."""
    total = sum(value.numel() for value in weights.values())
    for name, count in needed.items():
        if count > total:
            raise CheckpointError(
                f"{where}{name} asks for at least {count} weights; the checkpoint holds {total} in all. The"
                " configuration describes another network than the one that was saved, or the file is incomplete."
            )


def network_weights(weights: Weights) -> Weights:
    """Those of the policy that are not of its observation encoder."""
    return {key: value for key, value in weights.items() if not key.startswith("obs_encoder.")}


def load_network(network: nn.Module, weights: Weights) -> None:
    """Fill the network; every weight must be there, of the right shape, finite, and nothing else may be there."""
    expected = {f"model.{key}": value for key, value in network.state_dict().items()}
    found = {key: value for key, value in weights.items() if not _OTHER_KEY.fullmatch(key)}
    require_weights(expected, found, "cfg.policy.model", _MASKS)
    for key in _MASKS & found.keys():
        if not torch.equal(found[key], expected[key]):
            raise CheckpointError(f"{key} is not the causal mask of the original; the network was changed.")
    network.load_state_dict({key.removeprefix("model."): value for key, value in found.items()})


def affine(weights: Weights, key: str, width: int | None) -> Affine:
    """The normaliser of one field, one entry a channel; as it is saved where ``width`` is None."""
    vectors = {}
    for name in ("scale", "offset"):
        full = f"normalizer.params_dict.{key}.{name}"
        if full not in weights:
            raise CheckpointError(f"the weights hold no {full}; the policy was saved before its normaliser was set.")
        vector = weights[full]
        if not torch.isfinite(vector).all() or (name == "scale" and (vector == 0).any()):
            raise CheckpointError(f"{full} is {vector.tolist()}; expected finite numbers, and no zero in a scale.")
        if vector.ndim != 1 or len(vector) not in (1, width or len(vector)):
            found = tuple(vector.shape)
            raise CheckpointError(f"{full} has shape {found}; expected one entry for each of {width} channels.")
        # An identity normaliser has a single entry for all channels.
        vectors[name] = vector.expand(width or len(vector)).contiguous().numpy()
    return Affine(**vectors)


COMMON_KEYS = frozenset(
    {"_target_", "horizon", "n_action_steps", "n_obs_steps", "noise_scheduler", "num_inference_steps"}
)
"""Settings of ``cfg.policy`` that all have."""

MOST_PIXELS = 4096
"""Of an image along one axis, which the weights do not limit."""

Observed = Mapping[str, tuple[str, tuple[int, ...]]]
"""Type (``rgb``, ``low_dim``) and shape by key, in the order of the configuration."""


@dataclass(frozen=True)
class Saved:
    """What a checkpoint holds of one policy."""

    config: Config
    settings: Settings
    weights: Weights

    @property
    def policy(self) -> Mapping[str, Any]:
        """The entries of ``cfg.policy``."""
        return self.settings.values

    def sizes(self, *names: str) -> list[int]:
        """Positive whole numbers of ``cfg.policy``."""
        return [self.settings.number(name) for name in names]


@dataclass(frozen=True)
class Rebuilt:
    """What the module of one kind of policy makes of it.

    Attributes:
        module: denoiser with its weights, or ``EncodedDenoiser``.
        observations: what callers give, by key.
        sample: ``(T, D)``.
        action_dim: Da, the first of D channels.
        known: names of the settings of ``cfg.policy`` that were read, beside those that all have. The others are what
            the policy hands to every step of its scheduler.
        make: its loop, where ``noise_scheduler`` is none of diffusers'.
        executed: how many actions are; None where ``n_action_steps`` says so.
        prefix: see ``PolicySpec.trained_prefix``.
    """

    module: nn.Module
    observations: dict[str, ObservationSpec]
    sample: tuple[int, int]
    action_dim: int
    start: int
    variant: str
    known: frozenset[str]
    make: Make | None = None
    executed: int | None = None
    prefix: int = 0


def read_shape_meta(settings: Settings, *types: str) -> tuple[int, Observed]:
    """Channels of the action, and the observations, of ``cfg.policy.shape_meta``.

    Args:
        settings: ``cfg.policy``.
        types: of observations that the policy's encoder takes; the first is that of an entry without a type. None of
            them where it does not look at types.
    """
    meta = settings.values.get("shape_meta")
    if not isinstance(meta, dict) or not isinstance(meta.get("obs"), dict) or not isinstance(meta.get("action"), dict):
        raise settings.error("shape_meta is missing or malformed; expected {obs: {...}, action: {shape}}")
    observed = {}
    entries = {"action": meta["action"]} | {f"obs.{key}": each for key, each in meta["obs"].items()}
    for key, attributes in entries.items():
        each = Settings(attributes if isinstance(attributes, dict) else {}, f"{settings.where}shape_meta.{key}.")
        shape: Any = each.values.get("shape")
        if not is_shape(shape):
            raise each.refusal("shape", "positive whole numbers")
        kind = each.choice("type", *types) if types and key != "action" else "low_dim"
        if key == "action" and len(shape) != 1:
            raise each.refusal("shape", "one number")
        if kind == "rgb" and (len(shape) != 3 or max(shape) > MOST_PIXELS):
            raise each.refusal("shape", f"[C, H, W], {MOST_PIXELS} pixels at most")
        observed[key] = (kind, tuple(shape))
    _, (action_dim, *_) = observed.pop("action")
    if not observed:
        raise settings.error("shape_meta.obs names no observation")
    return action_dim, {key.removeprefix("obs."): each for key, each in observed.items()}


def observation_specs(observed: Observed, steps: int, weights: Weights) -> dict[str, ObservationSpec]:
    """What callers give, by key: images in 0..1, normalised by the module; the rest as the normaliser says."""
    return {
        key: ObservationSpec((steps, *shape), bounds=(0.0, 1.0))
        if kind == "rgb"
        else ObservationSpec((steps, *shape), affine(weights, key, shape[-1]))
        for key, (kind, shape) in observed.items()
    }


def image_normalizer(weights: Weights, key: str) -> tuple[float, float]:
    """Scale and offset of an image: the original has one of each for all channels and places."""
    single = affine(weights, key, None)
    if len(single.scale) != 1:
        raise CheckpointError(
            f"normalizer.params_dict.{key} has {len(single.scale)} entries; expected one for the whole image. Normalise"
            " the images before, and fit the policy with the identity."
        )
    return float(single.scale[0]), float(single.offset[0])


def network_settings(config: Config, network: str, names: Collection[str]) -> dict[str, Any]:
    """``cfg.policy.model``, the settings of a network that the configuration describes on its own."""
    found = str(config.require("policy.model._target_")).rpartition(".")[2]
    if found != network:
        raise CheckpointError(
            f"the policy's network is {found}; expected {network}. Use ttscompile.compile_denoiser(module, spec)"
            " on a network of your own."
        )
    values = dict(config.require("policy.model"))
    unknown = sorted(set(values) - {*names, "_target_"})
    if unknown:
        raise CheckpointError(
            f"cfg.policy.model has settings that {network} does not know: {', '.join(unknown)}. The network was"
            " changed; use ttscompile.compile_denoiser(module, spec)."
        )
    return values


def require_sizes(network: Any, expected: Mapping[str, int | None], given: str) -> None:
    """Raise unless ``cfg.policy.model`` has the sizes that follow from what the policy says, which ``given`` quotes."""
    for name, value in expected.items():
        if getattr(network, name) != value:
            found = f"{getattr(network, name)}; expected {value} with {given}"
            raise CheckpointError(f"cfg.policy.model.{name} is {found}.")


class _Given(nn.Module):
    """What is given an observation in some way."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model


class TokensDenoiser(_Given):
    """The observed steps are tokens of the network's own.

    Args:
        model: ``model(sample, timestep, tokens)``.
    """

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, ``[B]``, normalised ``[B, To, Do]`` -> ``[B, T, Da]``."""
        return self.model(sample, timestep, obs)  # type: ignore[no-any-return]


class GlobalDenoiser(_Given):
    """The observed steps are one vector, the same for the whole chunk.

    Args:
        model: ``model(sample, timestep, global_cond=vector)``.
    """

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, ``[B]``, normalised ``[B, To, Do]`` -> ``[B, T, Da]``."""
        return self.model(sample, timestep, global_cond=obs.flatten(1))  # type: ignore[no-any-return]


class LocalDenoiser(_Given):
    """The observed steps stand beside the first To of the sample; beside the others are zeros.

    Args:
        model: ``model(sample, timestep, local_cond=steps)``.
    """

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, ``[B]``, normalised ``[B, To, Do]`` -> ``[B, T, Da]``."""
        placed = nn.functional.pad(obs, (0, 0, 0, sample.shape[1] - obs.shape[1]))
        return self.model(sample, timestep, local_cond=placed)  # type: ignore[no-any-return]


class InpaintingDenoiser(nn.Module):
    """The sample holds the observation: its channels are action, then observation.

    The first To rows of the observation channels are overwritten before every evaluation, here inside the module. What
    the sampler makes of the overwritten entries is never read: every later evaluation overwrites them again, and they
    are not part of the action.
    """

    observed: torch.Tensor

    def __init__(self, model: nn.Module, sample: tuple[int, int], action_dim: int, n_obs_steps: int) -> None:
        super().__init__()
        self.model = model
        self.action_dim = action_dim
        self.n_obs_steps = n_obs_steps
        observed = torch.zeros(sample, dtype=torch.bool)
        observed[:n_obs_steps, action_dim:] = True
        self.register_buffer("observed", observed, persistent=False)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da + Do]``, ``[B]``, normalised ``[B, To, Do]`` -> ``[B, T, Da + Do]``."""
        steps = sample.shape[1]
        placed = nn.functional.pad(obs, (self.action_dim, 0, 0, steps - self.n_obs_steps))
        return self.model(torch.where(self.observed[:steps], placed, sample), timestep)  # type: ignore[no-any-return]
