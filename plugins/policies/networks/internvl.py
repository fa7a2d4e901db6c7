"""InternVL3 as transformers has it: images in a prompt, read by InternViT, and by Qwen2 together with the words.

An attribute's name is that of transformers' weights, or in a layer of InternViT that of CLIP's (``lerobot.evo1``).

Source: Zhu et al., InternVL3 (arXiv 2504.10479).
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from .clip import ACTIVATIONS, ImageTowerConfig, Layers
from .language_layers import LanguageConfig, Norm, Words, added, laid, rotation
from .siglip import squares

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of the colours that the image encoder was trained on, in 0..1."""


@dataclass(frozen=True)
class InternVitConfig(ImageTowerConfig):
    """The image encoder.

    Attributes:
        use_mean_pooling: whether what leaves the last layer is not normalised.
    """

    SCALED: ClassVar[bool] = True
    hidden_size: int = 1024
    intermediate_size: int = 4096
    num_hidden_layers: int = 24
    num_attention_heads: int = 16
    hidden_act: str = "gelu"
    layer_norm_eps: float = 1e-6
    image_size: int = 448
    patch_size: int = 14
    use_mean_pooling: bool = True


@dataclass(frozen=True)
class Prompt:
    """What the language model reads but for the words of the instruction, as tokens.

    Attributes:
        between: before each image, the first one first; of images that the robot has none of, too.
        images: that there are; the first so many.
        later: after the words of the instruction.
    """

    between: tuple[tuple[int, ...], ...]
    images: int
    later: tuple[int, ...] = ()


@dataclass(frozen=True)
class InternVLConfig:
    """Sizes and variant.

    Attributes:
        text: of the language model, whose first ``text.layers`` are used.
        scale: patches along each axis that become one token.
        activation: of the projector, as transformers calls it.
        base: of the rotary embedding.
    """

    vision: InternVitConfig
    text: LanguageConfig
    vocabulary: int
    scale: int
    activation: str
    base: float

    @property
    def image_tokens(self) -> int:
        """Tokens of one image."""
        return (self.vision.side // self.scale) ** 2


class _Embeddings(nn.Module):
    def __init__(self, config: InternVitConfig) -> None:
        super().__init__()
        width, patch = config.hidden_size, config.patch_size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.projection = nn.Conv2d(3, width, patch, stride=patch)
        self.position_embeddings = nn.Parameter(torch.zeros(1, config.side**2 + 1, width))

    def forward(self, pixels: Tensor) -> Tensor:
        patches = self.projection(pixels).flatten(2).transpose(1, 2)
        positions = self.position_embeddings[0]
        first = self.cls_token[0] + positions[:1]
        # The class token is a row of zeros to which it is added with its position: a constant, whatever the batch.
        return functional.pad(patches, (0, 0, 1, 0)) + torch.cat((first, positions[1:]))


class Colours(nn.Module):
    """Pixels in -1..1 ``[N, 3, H, W]`` normalised by the mean and the deviation of colours in 0..1."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, mean: tuple[float, ...] = MEAN, deviation: tuple[float, ...] = DEVIATION) -> None:
        super().__init__()
        # Made of numbers, so that a network without memory (on the meta device) has them all the same.
        colours = torch.tensor((mean, deviation), device="cpu")[:, :, None, None] * 2
        self.register_buffer("mean", colours[0] - 1, persistent=False)
        self.register_buffer("deviation", colours[1], persistent=False)

    def forward(self, pixels: Tensor) -> Tensor:
        """See the class."""
        return (pixels - self.mean) / self.deviation


class InternVit(nn.Module):
    """Pixels in -1..1 ``[N, 3, size, size]`` to patches ``[N, side ** 2, width]``."""

    def __init__(self, config: InternVitConfig) -> None:
        super().__init__()
        self.embeddings, self.encoder = _Embeddings(config), Layers(config)
        pooled = config.use_mean_pooling
        self.layernorm = nn.Identity() if pooled else nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)
        self.colours = Colours()

    def forward(self, pixels: Tensor) -> Tensor:
        """See the class."""
        tokens = self.embeddings(self.colours(pixels))
        return self.layernorm(self.encoder(tokens))[:, 1:]  # type: ignore[no-any-return]


class _Projector(nn.Module):
    """Squares of patches to tokens of the language model."""

    def __init__(self, config: InternVLConfig) -> None:
        super().__init__()
        features, width = config.vision.hidden_size * config.scale**2, config.text.width
        self.layer_norm = nn.LayerNorm(features)
        self.linear_1, self.linear_2 = nn.Linear(features, width), nn.Linear(width, width)
        self.activation, self.side, self.scale = config.activation, config.vision.side, config.scale

    def forward(self, patches: Tensor) -> Tensor:
        """``[N, patches, width]`` -> ``[N, tokens, width of the language model]``."""
        read = self.layer_norm(squares(patches, self.side, self.scale))
        return self.linear_2(ACTIVATIONS[self.activation](self.linear_1(read)))  # type: ignore[no-any-return]


class _Language(Words):
    def __init__(self, config: InternVLConfig) -> None:
        super().__init__(config.vocabulary, config.text)
        self.norm = Norm(config.text)


class InternVL(nn.Module):
    """Images and instruction to a feature of each token."""

    def __init__(self, config: InternVLConfig, prompt: Prompt) -> None:
        super().__init__()
        self.config, self.prompt = config, prompt
        self.vision_tower = InternVit(config.vision)
        self.multi_modal_projector = _Projector(config)
        self.language_model = _Language(config)

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Features ``[B, S, width]``, and which of them count ``[B, S]``.

        Images that the robot has none of have no features: nothing would read them. Their positions are left out.

        Args:
            images: of each camera ``[B, 3, H, W]``, in -1..1.
            tokens: of the instruction and what else is after the last image, int64 ``[B, L]``.
            mask: bool ``[B, L]``; padding is at the end.
        """
        seen = self.multi_modal_projector(self.vision_tower(torch.stack(images, 1).flatten(0, 1)))
        seen = seen.unflatten(0, (-1, len(images)))
        language, at, positions = self.language_model, 0, list[int]()
        for number, own in enumerate(self.prompt.between):
            positions += range(at, at + len(own))
            at += len(own)
            positions += range(at, at + self.config.image_tokens * (number < self.prompt.images))
            at += self.config.image_tokens
        valid = functional.pad(mask, (len(positions), 0), value=True)
        positions += range(at, at + tokens.shape[1])
        words = [
            language.embed_tokens(torch.tensor([each], device=mask.device)) if each else None
            for each in self.prompt.between
        ]
        x = laid(seen.unbind(1), words, language.embed_tokens(tokens))
        turns = rotation(torch.tensor([positions], device=mask.device), self.config.text.channels, self.config.base)
        causal = torch.ones(len(positions), len(positions), dtype=torch.bool, device=mask.device).tril()
        hidden = added(valid[:, None, None, :] & causal)
        for layer in language.layers:
            x = layer(x, turns, hidden)[0]
        return language.norm(x), valid

    def left_out(self, token: int, image: Tensor | None) -> Tensor:
        """Features of what FlashAttention leaves out: nothing attends to it, and it attends to nothing, ``[n, width]``.

        Args:
            token: of the padding, whose feature is the first one.
            image: ``[3, H, W]``, in -1..1, whose features are the others; None for none.
        """
        language = self.language_model
        x = language.embed_tokens.weight[token][None]
        if image is not None:
            x = torch.cat([x, self.multi_modal_projector(self.vision_tower(image[None]))[0]])
        layer: Any
        for layer in language.layers:
            x = x + layer.mlp(layer.post_attention_layernorm(x))
        return language.norm(x)  # type: ignore[no-any-return]
