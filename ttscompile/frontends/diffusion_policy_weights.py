"""The weights of a Diffusion Policy checkpoint: which of them, whether they fit, and the normalisers among them."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from ..core.spec import Affine
from ..errors import CheckpointError
from .saved_weights import as_float32, require_weights

_OTHER_KEY = re.compile(
    r"(model\.)?_dummy_variable|mask_generator\..*|normalizer\.params_dict\.\w+\.(scale|offset|input_stats\.\w+)"
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
