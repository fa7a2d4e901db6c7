"""The two encoders of CLIP, rebuilt from their configuration: image to class token, tokens to sentence feature.

A configuration is found on this machine, or is a released model's; nothing is ever downloaded. The networks are written
from their description, with attribute names under which the weights of transformers' ``CLIPModel`` load as they are, so
that converting a policy needs no transformers.

Source: Radford et al., Learning Transferable Visual Models From Natural Language Supervision (arXiv 2103.00020).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from torch import nn
from torch.nn import functional

from ttscompile.errors import CheckpointError
from ttscompile.frontends.settings import Settings, read_json

from ..instruction import NAME_FOLDER, find_encoder
from .language_layers import Rotation, rotate

_MOST = {"num_hidden_layers": 512, "image_size": 4096, "patch_size": 4096}
_MOST_OTHERWISE = 2**20
ACTIVATIONS: Mapping[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "quick_gelu": lambda x: x * torch.sigmoid(1.702 * x),
    "gelu": functional.gelu,
    "gelu_pytorch_tanh": lambda x: functional.gelu(x, approximate="tanh"),
}
"""By the names of transformers."""


@dataclass(frozen=True)
class TowerConfig:
    """One encoder; the names are those of transformers' configuration.

    Attributes:
        intermediate_size: width inside the feed-forward layers.
        hidden_act: ``quick_gelu``, ``gelu``, or ``gelu_pytorch_tanh``, which approximates it.
        SCALED: whether what a layer adds is first multiplied, channel by channel.
    """

    SCALED: ClassVar[bool] = False
    hidden_size: int
    intermediate_size: int
    num_hidden_layers: int
    num_attention_heads: int
    hidden_act: str = "quick_gelu"
    layer_norm_eps: float = 1e-5

    def __post_init__(self) -> None:
        settings = Settings(vars(self), "an encoder's ")
        for field in fields(self):
            whole = field.type in (int, "int")  # a text where annotations are not evaluated
            if whole and (field.name, vars(self)[field.name]) != ("eos_token_id", 0):  # no size: 0 is one
                settings.number(field.name, most=_MOST.get(field.name, _MOST_OTHERWISE))
        settings.choice("hidden_act", *ACTIVATIONS)
        if self.hidden_size % self.num_attention_heads:
            raise settings.refusal("hidden_size", f"a multiple of num_attention_heads = {self.num_attention_heads}")
        if not isinstance(self.layer_norm_eps, float) or not 0 < self.layer_norm_eps < 1:
            raise settings.refusal("layer_norm_eps", "a small positive number")


@dataclass(frozen=True)
class ImageTowerConfig(TowerConfig):
    """An image encoder: square images of ``image_size`` pixels in patches of ``patch_size``.

    Defaults, here and in the others, are what transformers takes for an entry that a file leaves out.
    """

    hidden_size: int = 768
    intermediate_size: int = 3072
    num_hidden_layers: int = 12
    num_attention_heads: int = 12
    image_size: int = 224
    patch_size: int = 32

    @property
    def side(self) -> int:
        """Patches along a side."""
        return self.image_size // self.patch_size


@dataclass(frozen=True)
class VisionConfig(ImageTowerConfig):
    """CLIP's image encoder."""

    num_channels: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_channels != 3 or self.patch_size > self.image_size:
            found = f"{self.num_channels}, its patch_size {self.patch_size} and its image_size {self.image_size}"
            expected = "3 channels, and patches that are no larger than the image"
            raise CheckpointError(f"CLIP's num_channels is {found}; expected {expected}.")


@dataclass(frozen=True)
class TextConfig(TowerConfig):
    """The text encoder; defaults as for ``VisionConfig``."""

    hidden_size: int = 512
    intermediate_size: int = 2048
    num_hidden_layers: int = 12
    num_attention_heads: int = 8
    vocab_size: int = 49408
    max_position_embeddings: int = 77
    eos_token_id: int = 49407


def _openai(layers: int, width: int, text: int, patch: int, size: int = 224) -> dict[str, Any]:
    """A released model: layers and width of the image encoder, width of the text encoder, pixels of patch and image."""
    vision = {"hidden_size": width, "num_hidden_layers": layers, "image_size": size, "patch_size": patch}
    # The end token is 2 in their configurations; the real one, 49407, is the largest there is.
    parts = {"vision_config": vision, "text_config": {"hidden_size": text, "eos_token_id": 2}}
    for part in parts.values():
        part |= {"intermediate_size": 4 * part["hidden_size"], "num_attention_heads": part["hidden_size"] // 64}
    return parts


RELEASED: Mapping[str, Mapping[str, Any]] = {
    "openai/clip-vit-base-patch16": _openai(12, 768, 512, 16),
    "openai/clip-vit-base-patch32": _openai(12, 768, 512, 32),
    "openai/clip-vit-large-patch14": _openai(24, 1024, 768, 14),
    "openai/clip-vit-large-patch14-336": _openai(24, 1024, 768, 14, 336),
}
"""Configurations of the released models: with these names nothing but the policy's own weights is needed."""

Tower = TypeVar("Tower", bound=TowerConfig)


def encoder_config(name: str, part: str, cls: type[Tower], folders: Sequence[Path]) -> Tower:
    """The configuration of one encoder: its ``part``, ``vision_config`` or ``text_config``, as a ``cls``."""
    found = find_encoder(name, folders)
    if found is not None:
        where, settings = str(found / "config.json"), read_json(found / "config.json")
    elif name in RELEASED:
        where, settings = name, dict(RELEASED[name])
    else:
        if Path(name).is_absolute() and Path(name).is_dir():
            raise CheckpointError(
                f"{name}: expected a config.json of CLIP, whose model_type begins with clip; found a directory without"
                f" one. Copy it there, or give another directory. {NAME_FOLDER}"
            )
        looked = ", ".join(dict.fromkeys(str(folder) for folder in folders))
        raise CheckpointError(
            f"the observation encoder {name!r} is not on this machine, and nothing is ever downloaded. Looked for a"
            f" directory {name!r} or {Path(name).name!r} with a config.json of CLIP in {looked}. Copy it there (and the"
            f" files of its tokenizer, to compile for one task). {NAME_FOLDER}"
        )
    alone = settings.get("model_type") == f"clip_{part.split('_')[0]}_model"
    inner: Any = settings if alone else settings.get(part)
    if not isinstance(inner, dict):
        raise CheckpointError(f"{where}: has no {part}; expected the configuration of a CLIP model.")
    names = {field.name for field in fields(cls)}
    try:
        return cls(**{key: value for key, value in inner.items() if key in names})
    except CheckpointError as error:
        raise CheckpointError(f"{where}: {error}") from error


class Attention(nn.Module):
    """Attention of ``width`` channels in all heads together; ``source`` is the width of what is looked at."""

    def __init__(self, width: int, heads: int, source: int | None = None) -> None:
        super().__init__()
        self.heads, self.channels = heads, width // heads
        self.q_proj, self.k_proj = nn.Linear(width, width), nn.Linear(source or width, width)
        self.v_proj, self.out_proj = nn.Linear(source or width, width), nn.Linear(width, width)

    def forward(
        self, x: torch.Tensor, seen: torch.Tensor, mask: torch.Tensor | None, turns: Rotation | None = None
    ) -> torch.Tensor:
        """``[B, T, width]`` that look at ``[B, S, source]`` -> ``[B, T, width]``.

        Args:
            mask: added to the scores, if there is one.
            turns: the rotary embedding of queries and keys, if there is one.
        """
        q, k, v = (
            project(tokens).unflatten(-1, (self.heads, self.channels)).transpose(1, 2)
            for project, tokens in ((self.q_proj, x), (self.k_proj, seen), (self.v_proj, seen))
        )
        if turns is not None:
            q, k = rotate(q, turns), rotate(k, turns)
        mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.out_proj(mixed.transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


class FeedForward(nn.Module):
    """Two layers with an activation between."""

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        self.fc1 = nn.Linear(config.hidden_size, config.intermediate_size)
        self.activation = config.hidden_act
        self.fc2 = nn.Linear(config.intermediate_size, config.hidden_size)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[..., width]`` -> the same."""
        return self.fc2(ACTIVATIONS[self.activation](self.fc1(x)))  # type: ignore[no-any-return]


class _Layer(nn.Module):
    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)
        self.self_attn = Attention(config.hidden_size, config.num_attention_heads)
        self.layer_norm2 = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)
        self.mlp = FeedForward(config)
        self.scaled = config.SCALED
        if self.scaled:
            self.lambda_1, self.lambda_2 = (nn.Parameter(torch.ones(config.hidden_size)) for _ in range(2))

    def forward(
        self, x: torch.Tensor, mask: torch.Tensor | None, read: int, turns: Rotation | None = None
    ) -> torch.Tensor:
        normed = self.layer_norm1(x)
        seen = self.self_attn(normed[:, :read], normed, mask, turns)
        x = x[:, :read] + (self.lambda_1 * seen if self.scaled else seen)
        made = self.mlp(self.layer_norm2(x))
        return x + (self.lambda_2 * made if self.scaled else made)  # type: ignore[no-any-return]


class Layers(nn.Module):
    """A tower's layers, one after the other; SigLIP and InternViT have the same."""

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        self.layers = nn.ModuleList(_Layer(config) for _ in range(config.num_hidden_layers))

    def forward(self, x: torch.Tensor, mask: torch.Tensor | None = None, read: int | None = None) -> torch.Tensor:
        """All layers; of the last one only the first ``read`` tokens, because nobody reads the others."""
        *others, last = self.layers
        for layer in others:
            x = layer(x, mask, x.shape[1])
        return last(x, mask, x.shape[1] if read is None else read)  # type: ignore[no-any-return]


class _VisionEmbeddings(nn.Module):
    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        width, patch = config.hidden_size, config.patch_size
        self.class_embedding = nn.Parameter(torch.zeros(width))
        self.patch_embedding = nn.Conv2d(config.num_channels, width, patch, stride=patch, bias=False)
        self.position_embedding = nn.Embedding(config.side**2 + 1, width)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        patches = self.patch_embedding(pixels).flatten(2).transpose(1, 2)
        positions = self.position_embedding.weight
        first = (self.class_embedding + positions[0])[None]
        # The class token is a row of zeros to which it is added with its position: a constant, whatever the batch.
        return functional.pad(patches, (0, 0, 1, 0)) + torch.cat((first, positions[1:]))


class ClipVision(nn.Module):
    """Pixels ``[N, 3, size, size]`` to the class token after the last layer ``[N, width]``, not normalised."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.embeddings = _VisionEmbeddings(config)
        # The names, spelling included, are those of the weights.
        self.pre_layrnorm = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)
        self.encoder = Layers(config)
        self.post_layernorm = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)  # of the pooled output

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """See the class."""
        tokens = self.pre_layrnorm(self.embeddings(pixels))
        return self.encoder(tokens, read=1)[:, 0]  # type: ignore[no-any-return]


class _TextEmbeddings(nn.Module):
    def __init__(self, config: TextConfig) -> None:
        super().__init__()
        self.token_embedding = nn.Embedding(config.vocab_size, config.hidden_size)
        self.position_embedding = nn.Embedding(config.max_position_embeddings, config.hidden_size)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        return self.token_embedding(tokens) + self.position_embedding.weight[: tokens.shape[1]]  # type: ignore[no-any-return]


class ClipText(nn.Module):
    """Tokens int64 ``[B, L]`` and their mask bool ``[B, L]`` to the feature of the end token ``[B, width]``.

    The end token is the first that equals ``eos_token_id``; for ``eos_token_id = 2``, which old configurations say
    wrongly, it is the largest of the row.
    """

    def __init__(self, config: TextConfig) -> None:
        super().__init__()
        self.end = config.eos_token_id
        self.embeddings = _TextEmbeddings(config)
        self.encoder = Layers(config)
        self.final_layer_norm = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)

    def features(self, tokens: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Of all tokens, ``[B, L, width]``, after the last norm."""
        length = tokens.shape[1]
        square = torch.ones(length, length, dtype=torch.bool, device=tokens.device)
        # Padding before a text sees itself: attention to nothing is not the same number everywhere. Nobody sees it.
        alone = torch.eye(length, dtype=torch.bool, device=mask.device) & ~mask[:, None, None, :1]
        added = torch.where(square.tril() & mask[:, None, None, :] | alone, 0.0, torch.finfo(torch.float32).min)
        return self.final_layer_norm(self.encoder(self.embeddings(tokens), added))  # type: ignore[no-any-return]

    def forward(self, tokens: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """See the class."""
        features = self.features(tokens, mask)
        ids = tokens.to(torch.int32)  # ArgMax of ONNX knows no int64
        end = (ids if self.end == 2 else (ids == self.end).to(torch.int32)).argmax(dim=-1)
        index = end[:, None, None].expand(-1, 1, features.shape[2])
        return torch.gather(features, 1, index)[:, 0]
