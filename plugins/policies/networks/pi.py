"""The network of pi0 and pi0.5: PaliGemma reads cameras and instruction, and an expert beside it denoises.

Attribute names are those under which lerobot saves the weights. Sources: Black et al., pi0 (arXiv 2410.24164) and pi0.5
(arXiv 2504.16054); ``lerobot.policies.pi0`` and ``pi05`` of huggingface/lerobot 0.6.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from . import language_layers as layers
from .siglip import Siglip, SiglipConfig


@dataclass(frozen=True)
class PiConfig:
    """Sizes and variant.

    Attributes:
        state: numbers of the state, padded; None in pi0.5, whose instruction holds the state.
        actions: numbers of an action, padded.
        periods: shortest and longest of the timestep's waves.
        trained_prefix: see ``PolicySpec``; pi0.5 alone may have one.
        rounded: whether frequencies of rotary positions are rounded to bfloat16. LeRobot and openpi's PyTorch cast
            them with a policy that they train in it, which knows no others.
        rounded_words: whether the scale of words is, which LeRobot alone casts.
    """

    vision: SiglipConfig
    text: layers.LanguageConfig
    vocabulary: int
    expert: layers.LanguageConfig
    state: int | None
    actions: int
    periods: tuple[float, float]
    trained_prefix: int = 0
    rounded: bool = False
    rounded_words: bool = False

    @property
    def adaptive(self) -> bool:
        """Whether the timestep modulates the expert's norms, as in pi0.5."""
        return self.state is None


class _Times(NamedTuple):
    """What modulates the norms of pi0.5: the time of the step ``[B, width]``.

    Where it was trained to go on from a prefix also that of clean actions ``[1, width]``, and which of them are, bool
    ``[B, T, 1]``.
    """

    step: Tensor
    clean: Tensor | None = None
    committed: Tensor | None = None


class _AdaptiveNorm(nn.Module):
    """Root mean square normalisation with scale, shift and gate of a condition."""

    def __init__(self, config: layers.LanguageConfig) -> None:
        super().__init__()
        self.dense = nn.Linear(config.width, 3 * config.width)
        self.epsilon = config.epsilon

    def forward(self, x: Tensor, times: _Times) -> tuple[Tensor, Tensor]:
        """``[B, T, width]`` -> what is normalised, and the gate ``[B, 1, width]``, or ``[B, T, width]``."""
        scale, shift, gate = self._modulation(times.step)
        if times.clean is not None and times.committed is not None:
            # All of a step or of clean actions is made before it is chosen: the choice alone is left in the loop.
            both = zip(self._modulation(times.clean), (scale, shift, gate), strict=True)
            scale, shift, gate = (torch.where(times.committed, clean, own) for clean, own in both)
        normed = x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + self.epsilon)
        return normed * scale + shift, gate

    def _modulation(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        scale, shift, gate = self.dense(time)[:, None].chunk(3, -1)
        return 1 + scale, shift, gate


class _ExpertLayer(nn.Module):
    """One layer of the expert, which sees the prefix and itself."""

    def __init__(self, config: PiConfig) -> None:
        super().__init__()
        norm: Any = _AdaptiveNorm if config.adaptive else layers.Norm
        self.adaptive = config.adaptive
        self.input_layernorm, self.post_attention_layernorm = norm(config.expert), norm(config.expert)
        self.self_attn, self.mlp = layers.Attention(config.expert), layers.FeedForward(config.expert)

    def forward(self, x: Tensor, prefix: layers.Seen, turns: layers.Rotation, mask: Tensor, times: _Times) -> Tensor:
        attention = self.self_attn
        normed, gate = self._normed(self.input_layernorm, x, times)
        queries = layers.rotate(attention.split(attention.q_proj(normed)), turns)
        keys = layers.rotate(attention.split(attention.k_proj(normed)), turns)
        pairs = ((prefix.keys, keys), (prefix.values, attention.split(attention.v_proj(normed))))
        seen = layers.Seen(*(torch.cat([attention.for_all_heads(each) for each in pair], 2) for pair in pairs))
        made = attention.attend(queries, seen, mask)
        x = x + (made if gate is None else made * gate)
        normed, gate = self._normed(self.post_attention_layernorm, x, times)
        made = self.mlp(normed)
        return x + (made if gate is None else made * gate)  # type: ignore[no-any-return]

    def _normed(self, norm: nn.Module, x: Tensor, times: _Times) -> tuple[Tensor, Tensor | None]:
        return norm(x, times) if self.adaptive else (norm(x), None)


class Pi(nn.Module):
    """The whole network, under the names of lerobot's ``PI0Pytorch``."""

    paligemma_with_expert: Any

    def __init__(self, config: PiConfig) -> None:
        super().__init__()
        self.config, width = config, config.expert.width
        both: Any = nn.Module()
        both.paligemma, both.gemma_expert = nn.Module(), nn.Module()
        both.paligemma.model, both.gemma_expert.model = nn.Module(), nn.Module()
        side = config.vision.image_size
        both.paligemma.model.vision_tower = Siglip(config.vision, (side, side))
        both.paligemma.model.multi_modal_projector = nn.Module()
        both.paligemma.model.multi_modal_projector.linear = nn.Linear(config.vision.hidden_size, config.text.width)
        both.paligemma.model.language_model = layers.Words(config.vocabulary, config.text)
        both.gemma_expert.model.layers = nn.ModuleList(_ExpertLayer(config) for _ in range(config.expert.layers))
        both.gemma_expert.model.norm = _AdaptiveNorm(config.expert) if config.adaptive else layers.Norm(config.expert)
        self.paligemma_with_expert = both
        self.action_in_proj, self.action_out_proj = nn.Linear(config.actions, width), nn.Linear(width, config.actions)
        if config.state is None:
            self.time_mlp_in, self.time_mlp_out = nn.Linear(width, width), nn.Linear(width, width)
        else:
            self.state_proj = nn.Linear(config.state, width)
            self.action_time_mlp_in = nn.Linear(2 * width, width)
            self.action_time_mlp_out = nn.Linear(width, width)


def _rates(config: layers.LanguageConfig, rounded: bool) -> Tensor | None:
    return layers.rounded_rates(config.channels) if rounded else None


class Prefix(nn.Module):
    """What the network reads once a call."""

    rates: Tensor | None

    def __init__(self, network: Pi) -> None:
        super().__init__()
        model = network.paligemma_with_expert.paligemma.model
        self.channels, self.width = network.config.text.channels, network.config.text.width
        scale, config = math.sqrt(self.width), network.config
        self.scale = float(torch.tensor(scale, dtype=torch.bfloat16, device="cpu")) if config.rounded_words else scale
        self.register_buffer("rates", _rates(config.text, config.rounded), persistent=False)
        self.vision_model, self.language_model = model.vision_tower, model.language_model
        self.projector = model.multi_modal_projector.linear
        self.state_proj: nn.Module | None = None if network.config.adaptive else network.state_proj

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor | None) -> tuple[Tensor, ...]:
        """Which tokens count, ``[B, P]``; in pi0 the state's token ``[B, 1, E]``; then keys and values of each layer.

        Args:
            images: of each camera ``[B, 3, H, W]``, in -1..1.
            tokens: int64 ``[B, L]``.
            mask: bool ``[B, L]``.
            state: padded ``[B, Ds]``; None in pi0.5.
        """
        seen = self.projector(self.vision_model(torch.stack(images, 1).flatten(0, 1)))
        seen = seen.reshape(-1, len(images) * seen.shape[1], self.width)
        words = self.language_model.embed_tokens(tokens) * self.scale
        valid = functional.pad(mask, (seen.shape[1], 0), value=True)
        turns = layers.rotation(torch.cumsum(valid, 1) - 1, self.channels, rates=self.rates)
        x = torch.cat([seen, words], 1)
        cache = layers.read_prefix(self.language_model.layers, x, turns, layers.prefix_mask(valid))
        own = [] if self.state_proj is None or state is None else [self.state_proj(state)[:, None]]
        return (valid, *own, *cache)


class Expert(nn.Module):
    """The denoiser."""

    rates: Tensor | None

    def __init__(self, network: Pi) -> None:
        super().__init__()
        model = network.paligemma_with_expert.gemma_expert.model
        self.config = network.config
        self.register_buffer("rates", _rates(network.config.expert, network.config.rounded), persistent=False)
        self.layers, self.norm = model.layers, model.norm
        self.action_in_proj, self.action_out_proj = network.action_in_proj, network.action_out_proj
        adaptive = network.config.adaptive
        self.mlp_in = network.time_mlp_in if adaptive else network.action_time_mlp_in
        self.mlp_out = network.time_mlp_out if adaptive else network.action_time_mlp_out

    def forward(self, sample: Tensor, timestep: Tensor, encoded: tuple[Tensor, ...]) -> Tensor:
        """``[B, T, D]``, times ``[B]`` from 1 to 0 and what ``Prefix`` gives -> the velocity ``[B, T, D]``.

        Where the policy was trained to go on from a prefix, what ``Prefix`` gives begins with how many actions are
        committed, int64 ``[B, 1]``: theirs is the time 0.
        """
        valid, *cache = encoded
        x = self.action_in_proj(sample)
        time = self._waves(timestep)
        times, own = _Times(time), torch.zeros(1, 1, device=x.device)
        if self.config.trained_prefix:
            count, valid, *cache = encoded
            committed = torch.arange(x.shape[1], device=x.device) < count
            clean = self._mixed(self._waves(torch.zeros(1, dtype=timestep.dtype, device=x.device)))
            times = _Times(self._mixed(time), clean, committed[..., None])
        elif self.config.adaptive:
            times = _Times(self._mixed(time))
        else:
            state, *cache = cache
            x = torch.cat([x, time[:, None].expand_as(x)], 2)
            x = torch.cat([state, self.mlp_out(functional.silu(self.mlp_in(x)))], 1)
            # The state does not see the actions.
            groups = torch.arange(x.shape[1], device=x.device) > 0
            own = layers.added(groups[None, :] <= groups[:, None])
        count = x.shape[1]
        places = valid.sum(-1, keepdim=True) + torch.arange(count, device=x.device)[None]
        turns = layers.rotation(places, self.config.expert.channels, rates=self.rates)
        before = layers.added(valid[:, None, None, :]).expand(-1, -1, count, -1)
        mask = torch.cat([before, own.expand(len(sample), 1, count, count)], 3)
        for i, layer in enumerate(self.layers):
            x = layer(x, layers.Seen(cache[2 * i], cache[2 * i + 1]), turns, mask, times)
        actions = x[:, -sample.shape[1] :]
        normed = self.norm(actions, times)[0] if self.config.adaptive else self.norm(actions)
        return self.action_out_proj(normed)  # type: ignore[no-any-return]

    def _waves(self, time: Tensor) -> Tensor:
        return layers.waves(time, self.config.expert.width, *self.config.periods)

    def _mixed(self, waves: Tensor) -> Tensor:
        return functional.silu(self.mlp_out(functional.silu(self.mlp_in(waves))))
