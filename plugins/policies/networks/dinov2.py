"""DINOv2 with registers as timm has it: a picture to one feature for each of its patches.

Its layers are those of CLIP's encoders, with what each adds scaled channel by channel; ``own_names`` gives them timm's
weights.

Source: Oquab et al., DINOv2 (arXiv 2304.07193); Darcet et al., Vision Transformers Need Registers (arXiv 2309.16588).
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
class DinoConfig(TowerConfig):
    """Sizes.

    Attributes:
        grid: patches along the height and the width of a picture.
        registers: tokens of no patch, beside the class token.
        patch_size: pixels of a patch along each side.
    """

    SCALED: ClassVar[bool] = True
    hidden_act: str = "gelu"
    layer_norm_eps: float = 1e-6
    grid: tuple[int, int] = (16, 16)
    registers: int = 4
    patch_size: int = 14


class DinoV2(nn.Module):
    """Normalised pixels ``[N, 3, H, W]`` to features ``[N, patches, width]``.

    Args:
        kept: the patches that are looked at, by their number; None for all.
    """

    kept: Tensor

    def __init__(self, config: DinoConfig, kept: Sequence[int] | None = None) -> None:
        super().__init__()
        width, patch = config.hidden_size, config.patch_size
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, width, patch, stride=patch)})
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.reg_token = nn.Parameter(torch.zeros(1, config.registers, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, config.grid[0] * config.grid[1], width))
        self.encoder = Layers(config)
        self.norm = nn.LayerNorm(width, eps=config.layer_norm_eps)
        self.first, self.some = 1 + config.registers, kept is not None
        # Made of numbers, so that a network without memory (on the meta device) has them all the same.
        self.register_buffer("kept", torch.tensor(kept or [0], device="cpu"), persistent=False)

    def forward(self, pixels: Tensor) -> Tensor:
        """See the class."""
        patches: Tensor = self.patch_embed["proj"](pixels).flatten(2).transpose(1, 2)
        places: Tensor = self.pos_embed
        if self.some:
            patches, places = patches[:, self.kept], places[:, self.kept]
        # Tokens without a patch are rows of zeros to which they are added: a constant, whatever the batch.
        tokens = functional.pad(patches, (0, 0, self.first, 0)) + torch.cat((self.cls_token, self.reg_token, places), 1)
        return self.norm(self.encoder(tokens))[:, self.first :]  # type: ignore[no-any-return]


def own_names(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights as timm calls them, or of a network that has such a tower, under the names that they have here."""
    found: dict[str, Tensor] = {}
    for name, value in weights.items():
        own = renamed(name, _RENAMED)
        found |= separated(own, value) if ".qkv." in own else {own: value}
    return found
