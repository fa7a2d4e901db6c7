"""Vision transformers as timm has them, CLIP's and DINOv2's among them: a picture to tokens.

Their layers are those of CLIP's encoders, where DINOv2 scales what each adds channel by channel; ``own_names`` gives
them timm's weights.

Source: Dosovitskiy et al. (arXiv 2010.11929); Oquab et al., DINOv2 (arXiv 2304.07193); Darcet et al., Vision
Transformers Need Registers (arXiv 2309.16588); ``VisionTransformer`` of timm 0.9.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.frontends.saved_weights import renamed, separated

from .clip import Layers, TowerConfig

_RENAMED = (
    (r"(^|\.)blocks\.", r"\1encoder.layers."),
    (r"\.norm([12])\.", r".layer_norm\1."),
    (r"\.attn\.proj\.", ".self_attn.out_proj."),
    (r"\.attn\.qkv\.", ".self_attn.qkv."),
    (r"\.ls([12])\.gamma$", r".lambda_\1"),
)


@dataclass(frozen=True)
class VitConfig(TowerConfig):
    """Sizes and variant.

    Attributes:
        grid: patches along the height and the width of a picture.
        patch_size: pixels of a patch along each side.
        before: tokens of no patch, which stand before the others: the class token, and registers if there are any.
        placed: whether these have positions, too.
        normed: whether tokens are normalised before the layers, as CLIP's are. Its patches have no bias.
    """

    hidden_act: str = "gelu"
    layer_norm_eps: float = 1e-6
    grid: tuple[int, int] = (14, 14)
    patch_size: int = 16
    before: int = 1
    placed: bool = True
    normed: bool = False


@dataclass(frozen=True)
class DinoConfig(VitConfig):
    """The same of DINOv2, by default with four registers."""

    SCALED: ClassVar[bool] = True
    grid: tuple[int, int] = (16, 16)
    patch_size: int = 14
    before: int = 5
    placed: bool = False


class TimmVit(nn.Module):
    """Pictures ``[N, 3, H, W]`` to tokens ``[N, tokens, width]``, normalised at the end: those of no patch come first.

    Args:
        kept: the patches that are looked at, by their number; None for all.
        read: how many tokens are wanted, from the first on; None for all. Of the others the last layer gives nothing.
    """

    kept: Tensor

    def __init__(self, config: VitConfig, kept: Sequence[int] | None = None, read: int | None = None) -> None:
        super().__init__()
        self.config, self.read, self.some = config, read, kept is not None
        width, patch, count = config.hidden_size, config.patch_size, config.grid[0] * config.grid[1]
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, width, patch, stride=patch, bias=not config.normed)})
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.reg_token = nn.Parameter(torch.zeros(1, config.before - 1, width)) if config.before > 1 else None
        self.pos_embed = nn.Parameter(torch.zeros(1, count + config.before * config.placed, width))
        eps = config.layer_norm_eps
        self.norm_pre = nn.LayerNorm(width, eps=eps) if config.normed else nn.Identity()
        self.encoder = Layers(config)
        self.norm = nn.LayerNorm(width, eps=eps)
        # Made of numbers, so that a network without memory (on the meta device) has them all the same.
        self.register_buffer("kept", torch.tensor(kept or [0], device="cpu"), persistent=False)

    def forward(self, pixels: Tensor) -> Tensor:
        """See the class."""
        before = self.config.before
        patches: Tensor = self.patch_embed["proj"](pixels).flatten(2).transpose(1, 2)
        first = self.cls_token if self.reg_token is None else torch.cat((self.cls_token, self.reg_token), 1)
        places: Tensor = self.pos_embed
        if self.config.placed:
            first, places = first + places[:, :before], places[:, before:]
        if self.some:
            patches, places = patches[:, self.kept], places[:, self.kept]
        # Tokens without a patch are rows of zeros to which they are added: a constant, whatever the batch.
        tokens = functional.pad(patches, (0, 0, before, 0)) + torch.cat((first, places), 1)
        return self.norm(self.encoder(self.norm_pre(tokens), read=self.read))  # type: ignore[no-any-return]


def own_names(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights as timm calls them, or of a network that has such a tower, under the names that they have here."""
    found: dict[str, Tensor] = {}
    for name, value in weights.items():
        own = renamed(name, _RENAMED)
        found |= separated(own, value) if ".qkv." in own else {own: value}
    return found
