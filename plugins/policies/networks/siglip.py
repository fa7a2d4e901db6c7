"""The image encoder SigLIP, alone or as SmolVLM2 and PaliGemma have it: an image to one feature for each patch.

Its layers are those of CLIP's encoders. Attribute names are those under which the weights of transformers load.

Source: Zhai et al., Sigmoid Loss for Language Image Pre-Training (arXiv 2303.15343).
"""

from dataclasses import dataclass

import torch
from torch import nn

from .clip import ImageTowerConfig, Layers


@dataclass(frozen=True)
class SiglipConfig(ImageTowerConfig):
    """The encoder, as SmolVLM has it; in images of ``image_size`` pixels a side every patch has its own position."""

    hidden_size: int = 1152
    num_attention_heads: int = 16
    hidden_act: str = "gelu_pytorch_tanh"
    layer_norm_eps: float = 1e-6


class _Embeddings(nn.Module):
    def __init__(self, config: SiglipConfig) -> None:
        super().__init__()
        width, patch = config.hidden_size, config.patch_size
        self.patch_embedding = nn.Conv2d(3, width, patch, stride=patch)
        self.position_embedding = nn.Embedding(config.side**2, width)

    def forward(self, pixels: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
        patches = self.patch_embedding(pixels).flatten(2).transpose(1, 2)
        return patches + self.position_embedding.weight[positions]  # type: ignore[no-any-return]


class Siglip(nn.Module):
    """Pixels in -1..1 ``[N, 3, H, W]`` to patches ``[N, H/patch * W/patch, width]``, normalised at the end.

    Args:
        size: height and width of pictures whose patches have positions by their share, as SmolVLM has it; None for
            pictures of the configuration's size, each of whose patches has its own.
    """

    positions: torch.Tensor

    def __init__(self, config: SiglipConfig, size: tuple[int, int] | None = None) -> None:
        super().__init__()
        self.embeddings = _Embeddings(config)
        self.encoder = Layers(config)
        self.post_layernorm = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)
        if size is None:
            rows = list(range(config.side**2))
        else:
            height, width = (_buckets(n // config.patch_size, config.side) for n in size)
            rows = [row * config.side + column for row in height for column in width]
        # Made of numbers, so that a network without memory (on the meta device) has them all the same.
        self.register_buffer("positions", torch.tensor(rows, device="cpu"), persistent=False)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """See the class."""
        return self.post_layernorm(self.encoder(self.embeddings(pixels, self.positions)))  # type: ignore[no-any-return]


def squares(patches: torch.Tensor, side: int, scale: int) -> torch.Tensor:
    """Squares of ``scale`` by ``scale`` patches as one row each.

    Args:
        patches: ``[N, P, C]``; of them come ``[N, squares, scale ** 2 * C]``.
        side: patches along the height of the image.
    """
    rows, columns = side // scale, patches.shape[1] // side // scale
    grid = patches.reshape(-1, rows, scale, columns, scale, patches.shape[-1])
    # Rows and columns of a square stand beside each other, and its features one patch after the other.
    return grid.transpose(2, 3).flatten(3).flatten(1, 2)


def _buckets(count: int, side: int) -> list[int]:
    """Which of ``side`` positions each of ``count`` patches has: by its share of the image, as SmolVLM rounds it."""
    step = torch.tensor(1.0, device="cpu") / count
    share = torch.clamp(torch.arange(count, dtype=torch.float32, device="cpu") * step, max=1.0 - 1e-6)
    boundaries = torch.arange(1 / side, 1.0, 1 / side, device="cpu")
    return [int(n) for n in torch.bucketize(share, boundaries, right=True)]
