"""SmolVLA's network: cameras, instruction and state to keys and values of a prefix; and the expert that denoises.

Attribute names are those under which lerobot saves the weights. Sources: Shukor et al., SmolVLA (arXiv 2506.01844);
``lerobot.policies.smolvla`` of huggingface/lerobot 0.6.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from . import language_layers as layers
from .siglip import Siglip, SiglipConfig, squares

_MULTIPLE = 256
"""Of the expert's feed-forward layers."""


@dataclass(frozen=True)
class SmolVLAConfig:
    """Sizes and variant.

    Attributes:
        text: of the language model, whose first ``text.layers`` are used.
        scale: patches along each axis that become one token.
        image: height and width of the images that the encoder sees.
        crosses: whether layer ``i`` of the expert sees the prefix alone; otherwise prefix and actions.
        every: so many layers of the language model are one of the expert, which sees the first of them.
        state: numbers of the state, padded.
        actions: numbers of an action, padded.
        periods: shortest and longest of the timestep's waves.
        around: tokens before each image, and after it.
        absent: cameras of which there are these tokens alone, after all images.
    """

    vision: SiglipConfig
    text: layers.LanguageConfig
    vocabulary: int
    scale: int
    image: tuple[int, int]
    expert: layers.LanguageConfig
    crosses: tuple[bool, ...]
    state: int
    actions: int
    periods: tuple[float, float]
    every: int = 1
    around: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())
    absent: int = 0


def expert_of(text: layers.LanguageConfig, multiplier: float) -> layers.LanguageConfig:
    """The expert beside a language model: narrower, with the same heads."""
    width = int(text.width * multiplier)
    hidden = _MULTIPLE * math.ceil(int(4 * int(2 * width / 3)) / _MULTIPLE)
    return layers.LanguageConfig(width, hidden, text.layers, text.heads, text.groups, text.channels, text.epsilon)


class _Connector(nn.Module):
    """Squares of ``scale`` by ``scale`` patches to one token each."""

    modality_projection: Any

    def __init__(self, config: SmolVLAConfig) -> None:
        super().__init__()
        self.scale = config.scale
        self.rows = config.image[0] // config.vision.patch_size
        self.modality_projection = nn.Module()
        width = config.vision.hidden_size * config.scale**2
        self.modality_projection.proj = nn.Linear(width, config.text.width, bias=False)

    def forward(self, patches: Tensor) -> Tensor:
        """``[N, patches, width]`` -> ``[N, tokens, width of the language model]``."""
        return self.modality_projection.proj(squares(patches, self.rows, self.scale))  # type: ignore[no-any-return]


class _ExpertLayer(nn.Module):
    def __init__(self, config: SmolVLAConfig, crosses: bool) -> None:
        super().__init__()
        expert = config.expert
        self.crosses = crosses
        self.input_layernorm, self.post_attention_layernorm = layers.Norm(expert), layers.Norm(expert)
        self.self_attn = layers.Attention(expert, config.text.groups * config.text.channels if crosses else None)
        self.mlp = layers.FeedForward(expert)

    def forward(
        self, x: Tensor, prefix: layers.Seen, turns: layers.Rotation, own_turns: layers.Rotation, mask: Tensor
    ) -> Tensor:
        """``prefix`` in groups; ``mask`` of the prefix, or of prefix and actions."""
        attention = self.self_attn
        normed = self.input_layernorm(x)
        queries = attention.split(attention.q_proj(normed))
        if self.crosses:
            keys, values = (each.transpose(1, 2).flatten(2) for each in prefix)
            keys, values = attention.split(attention.k_proj(keys)), attention.split(attention.v_proj(values))
            seen = layers.Seen(attention.for_all_heads(keys), attention.for_all_heads(values))
            x = x + attention.attend(layers.rotate(queries, own_turns), seen, mask)
        else:
            keys = layers.rotate(attention.split(attention.k_proj(normed)), turns)
            values = attention.split(attention.v_proj(normed))
            pairs = ((prefix.keys, keys), (prefix.values, values))
            seen = layers.Seen(*(torch.cat([attention.for_all_heads(each) for each in pair], 2) for pair in pairs))
            x = x + attention.attend(layers.rotate(queries, turns), seen, mask)
        return x + self.mlp(self.post_attention_layernorm(x))  # type: ignore[no-any-return]


class SmolVLA(nn.Module):
    """The whole network, under the names of lerobot's ``VLAFlowMatching``."""

    vlm_with_expert: Any

    def __init__(self, config: SmolVLAConfig) -> None:
        super().__init__()
        width = config.expert.width
        both: Any = nn.Module()
        self.config = config
        both.vlm = nn.Module()
        both.vlm.model = nn.Module()
        both.vlm.model.vision_model = Siglip(config.vision, config.image)
        both.vlm.model.connector = _Connector(config)
        both.vlm.model.text_model = layers.Words(config.vocabulary, config.text)
        both.lm_expert = nn.Module()
        both.lm_expert.layers = nn.ModuleList(_ExpertLayer(config, crosses) for crosses in config.crosses)
        both.lm_expert.norm = layers.Norm(config.expert)
        self.vlm_with_expert = both
        self.state_proj = nn.Linear(config.state, config.text.width)
        self.action_in_proj, self.action_out_proj = nn.Linear(config.actions, width), nn.Linear(width, config.actions)
        self.action_time_mlp_in, self.action_time_mlp_out = nn.Linear(2 * width, width), nn.Linear(width, width)


class Prefix(nn.Module):
    """What the network reads once a call."""

    def __init__(self, network: SmolVLA) -> None:
        super().__init__()
        model: Any = network.vlm_with_expert.vlm.model
        config = self.config = network.config
        self.channels, self.width = config.text.channels, config.text.width
        self.vision_model, self.connector, self.text_model = model.vision_model, model.connector, model.text_model
        self.state_proj = network.state_proj

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """Which tokens count, ``[B, P]``, then keys and values of each layer.

        Args:
            images: of each camera ``[B, 3, H, W]``, in -1..1.
            tokens: int64 ``[B, L]``.
            mask: bool ``[B, L]``.
            state: padded ``[B, Ds]``.
        """
        scale = math.sqrt(self.width)
        seen = self.connector(self.vision_model(torch.stack(images, 1).flatten(0, 1))) * scale
        seen, rest = seen.unflatten(0, (-1, len(images))), list[Tensor]()
        if any(self.config.around):
            both = (torch.tensor(each, device=tokens.device) for each in self.config.around)
            before, after = (self.text_model.embed_tokens(each).expand(*seen.shape[:2], -1, -1) for each in both)
            seen, rest = torch.cat([before, seen, after], 2), [before[:, 0], after[:, 0]] * self.config.absent
        words = self.text_model.embed_tokens(tokens) * scale
        x = torch.cat([seen.flatten(1, 2), *rest, words], 1)
        valid = functional.pad(mask, (x.shape[1] - words.shape[1], 0), value=True)
        turns = layers.rotation(torch.cumsum(valid, 1) - 1, self.channels)
        early = layers.read_prefix(self.text_model.layers, x, turns, layers.prefix_mask(valid))
        # Images and words do not see the state, whose token follows by itself: what was made of them may be kept.
        turns = layers.rotation(valid.sum(1, keepdim=True), self.channels)
        valid = functional.pad(valid, (0, 1), value=True)
        before = [layers.Seen(*early[i : i + 2]) for i in range(0, len(early), 2)]
        mask, own = layers.added(valid[:, None, None, :]), self.state_proj(state)[:, None]
        late = layers.read_prefix(self.text_model.layers, own, turns, mask, before)
        return valid, *(torch.cat(pair, 2) for pair in zip(early, late, strict=True))


class Expert(nn.Module):
    """The denoiser."""

    def __init__(self, network: SmolVLA) -> None:
        super().__init__()
        expert: Any = network.vlm_with_expert.lm_expert
        self.config = network.config
        self.layers, self.norm = expert.layers, expert.norm
        self.action_in_proj, self.action_out_proj = network.action_in_proj, network.action_out_proj
        self.action_time_mlp_in = network.action_time_mlp_in
        self.action_time_mlp_out = network.action_time_mlp_out

    def forward(self, sample: Tensor, timestep: Tensor, encoded: tuple[Tensor, ...]) -> Tensor:
        """``[B, T, D]``, times ``[B]`` from 1 to 0 and what ``Prefix`` gives -> the velocity ``[B, T, D]``."""
        valid, *seen = encoded
        config, count = self.config, sample.shape[1]
        x = self.action_in_proj(sample)
        time = layers.waves(timestep, config.expert.width, *config.periods)
        x = torch.cat([x, time[:, None].expand_as(x)], 2)
        x = self.action_time_mlp_out(functional.silu(self.action_time_mlp_in(x)))
        own = torch.arange(count, device=x.device)[None]
        own_turns = layers.rotation(own, config.expert.channels)
        turns = layers.rotation(valid.sum(-1, keepdim=True) + own, config.expert.channels)
        crossing = layers.added(valid[:, None, None, :])
        # Actions see the prefix, and each other backwards in time.
        later = layers.added(torch.ones(count, count, dtype=torch.bool, device=x.device).tril())[None, None]
        whole = torch.cat([crossing.expand(-1, -1, count, -1), later.expand(len(sample), -1, -1, -1)], 3)
        for i, layer in enumerate(self.layers):
            prefix = layers.Seen(*seen[2 * i * config.every :][:2])
            x = layer(x, prefix, turns, own_turns, crossing if layer.crosses else whole)
        return self.action_out_proj(self.norm(x))  # type: ignore[no-any-return]
