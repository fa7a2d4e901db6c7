"""Compile the action expert of your own SmolVLA policy: its ``denoise_step``, as LeRobot has it.

The vision-language model runs once a call, with your code, and leaves a cache of keys and values. A compiled policy
takes tensors, so the cache is two of them: ``keys`` and ``values`` ``[B, layers, heads, prefix, channels]``.

    policy = SmolVLAPolicy.from_pretrained("lerobot/smolvla_base").float()
    compile_head(policy.model, past_key_values, "compiled/")    # the cache of any observation: only its sizes count

On the robot::

    expert = ttscompile.load("compiled/")
    keys, values = flatten_cache(past_key_values)               # from your own code's prefix pass
    out = expert.predict_action({"prefix_mask": prefix_mask, "keys": keys, "values": values})
    actions = out["action_pred"]                                # normalised, [B, chunk, max_action_dim]
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

import ttscompile
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.samplers.flow import flow_matching_table


class PrefixCache:
    """What a layer needs of a transformers ``DynamicCache``: it appends to tensors that came from outside."""

    class Layer:
        """Keys and values ``[B, heads, prefix, channels]`` of one layer."""

        def __init__(self, keys: Tensor, values: Tensor) -> None:
            self.keys, self.values = keys, values

    def __init__(self, keys: Tensor, values: Tensor) -> None:
        pairs = zip(keys.unbind(1), values.unbind(1), strict=True)
        self.layers = [self.Layer(k, v) for k, v in pairs]

    def update(self, keys: Tensor, values: Tensor, layer: int, *_: Any, **__: Any) -> tuple[Tensor, Tensor]:
        """Those of the prefix, then these; nothing is kept, so that a step does not see the one before."""
        own = self.layers[layer]
        return torch.cat([own.keys, keys], 2), torch.cat([own.values, values], 2)

    def crop(self, length: int) -> None:
        """Nothing was appended."""

    def get_seq_length(self, layer: int = 0) -> int:
        """Tokens of the prefix."""
        return self.layers[layer].keys.shape[2]

    def __len__(self) -> int:
        return len(self.layers)


class Head(nn.Module):
    """``denoise_step`` as a function of tensors."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model: Any = model

    def forward(self, sample: Tensor, timestep: Tensor, prefix_mask: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        """The velocity ``[B, T, D]``."""
        return self.model.denoise_step(
            prefix_pad_masks=prefix_mask, past_key_values=PrefixCache(keys, values), x_t=sample, timestep=timestep
        )


def flatten_cache(cache: Any) -> tuple[Tensor, Tensor]:
    """Keys and values of a ``DynamicCache``, ``[B, layers, heads, prefix, channels]`` each."""
    keys, values = [layer.keys for layer in cache.layers], [layer.values for layer in cache.layers]
    return torch.stack(keys, 1), torch.stack(values, 1)


def compile_head(model: nn.Module, cache: Any, directory: str | Path, **arguments: Any) -> Any:
    """Compile ``model.denoise_step`` for prefixes as long as that of ``cache``.

    Args:
        model: SmolVLA's ``VLAFlowMatching``, in float32.
        cache: what its prefix pass gave for one observation, padded to the length that the robot will use.
        directory: where the artifact goes.
        arguments: further ones of ``ttscompile.compile_denoiser``.
    """
    keys, values = flatten_cache(cache)
    config: Any = model.config
    spec = PolicySpec(
        sample=(config.chunk_size, config.max_action_dim),
        observations={
            "prefix_mask": ObservationSpec((keys.shape[3],), dtype="bool"),
            "keys": ObservationSpec(keys.shape[1:], window=False),
            "values": ObservationSpec(values.shape[1:], window=False),
        },
        sampler=flow_matching_table(config.num_steps, start=1.0, end=0.0),
        chunk=ChunkSpec(config.max_action_dim, 0, config.chunk_size),
    )
    return ttscompile.compile_denoiser(Head(model), spec, directory, **arguments)
