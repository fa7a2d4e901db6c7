"""What every policy of Diffusion Policy has, whatever its network: what was saved of it, what is rebuilt of that."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from torch import nn

from ..core.spec import ObservationSpec
from ..errors import CheckpointError
from .diffusion_policy_weights import Weights, affine
from .interpolation import Config
from .settings import Settings, is_shape

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
    """

    module: nn.Module
    observations: dict[str, ObservationSpec]
    sample: tuple[int, int]
    action_dim: int
    start: int
    variant: str
    known: frozenset[str]


def read_shape_meta(settings: Settings, *types: str) -> tuple[int, Observed]:
    """Channels of the action, and the observations, of ``cfg.policy.shape_meta``.

    Args:
        settings: ``cfg.policy``.
        types: of observations that the policy's encoder takes; the first is that of an entry without a type.
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
        kind = types[0] if key == "action" else each.choice("type", *types)
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
