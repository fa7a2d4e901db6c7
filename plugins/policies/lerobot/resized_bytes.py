"""Resizing images of bytes with a cubic or linear filter as Pillow and torchvision do, bit for bit, as matrix products.

Both multiply by whole numbers, and round after the rows and again after the columns. Sources: ``Resample.c`` of Pillow,
and ``UpSampleKernelAVXAntialias.h`` of PyTorch, which torchvision calls for images of bytes on a processor.

On a graphics card torchvision makes them floats, and rounds once, at the end. In float32 a sum depends on its order, so
there it is chance which byte one of 100,000 becomes, and every half. Here weights are those of float32, but sums are in
float64, and halves go up: so all runtimes come to the same bytes.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from ..networks.image_geometry import ResizeCrop, resize_matrix
from ..networks.internvl import Colours

Filter = Literal["pillow", "torchvision", "card"]
"""The last is torchvision on a graphics card."""
_MOST_BITS, _LONGEST = 22, 2**15
"""Bits after the point of a weight; torchvision takes as many as leave its largest one below 2 ** 15."""

_NEARLY = 1e-6
"""What is so little below a half is one: no order of the sums in float64 makes as much of a difference."""


def resized(before: tuple[int, int], after: tuple[int, int], own: Filter, mode: str = "bicubic") -> nn.Module:
    """What makes of images ``[..., H, W]`` of whole numbers in 0..255, as float32, others of another height and width.

    Args:
        before: height and width.
        after: likewise.
        mode: ``bicubic``, or ``bilinear`` but on a graphics card.
    """
    return _OnceRounded(before, after) if own == "card" else _TwiceRounded(before, after, own, mode)


class _OnceRounded(nn.Module):
    def __init__(self, before: tuple[int, int], after: tuple[int, int]) -> None:
        super().__init__()
        self.zoom = ResizeCrop(*before, after, mode="bicubic")

    def forward(self, pixels: Tensor) -> Tensor:
        rows, columns = (each.to(torch.float64) for each in (self.zoom.rows, self.zoom.columns))
        return _rounded(rows @ pixels.to(torch.float64) @ columns + _NEARLY).to(torch.float32)


class _TwiceRounded(nn.Module):
    rows: Tensor
    columns: Tensor

    def __init__(self, before: tuple[int, int], after: tuple[int, int], own: Filter, mode: str) -> None:
        super().__init__()
        rows, columns = (_weights(old, new, own, mode) for old, new in zip(before, after, strict=True))
        for name, value in (("rows", rows), ("columns", columns.T)):
            made = torch.tensor(np.ascontiguousarray(value), dtype=torch.float32, device="cpu")
            self.register_buffer(name, made, persistent=False)

    def forward(self, pixels: Tensor) -> Tensor:
        # Sums are exact in float64; and such products are made in eight bits by no precision of an artifact.
        pixels = _rounded(pixels.to(torch.float64) @ self.columns.to(torch.float64))
        return _rounded(self.rows.to(torch.float64) @ pixels).to(torch.float32)


class Shown(nn.Module):
    """Images of each camera in -1..1 as a vision transformer sees them: resized as bytes, and normalised.

    Args:
        sizes: of each camera height and width, and then those of all that it is resized to in turn.
        lower: whether what is between two bytes becomes the lower one; else it becomes the nearest.
    """

    def __init__(
        self,
        sizes: Sequence[Sequence[tuple[int, int]]],
        own: Filter,
        mean: tuple[float, ...],
        deviation: tuple[float, ...],
        lower: bool = False,
    ) -> None:
        super().__init__()
        pairs = ([pair for pair in pairwise(each) if pair[0] != pair[1]] for each in sizes)
        self.zooms = nn.ModuleList(nn.Sequential(*(resized(*pair, own) for pair in each)) for each in pairs)
        self.colours, self.lower = Colours(mean, deviation), lower

    def forward(self, images: list[Tensor]) -> list[Tensor]:
        """See the class."""
        shown = []
        for image, zoom in zip(images, self.zooms, strict=True):
            pixels = (image + 1) * 127.5
            # A byte that came as a fraction of 255, and was moved to -1..1 and back, may be a little below itself.
            pixels = ((pixels + 2e-5).floor() if self.lower else pixels.round()).clamp(0, 255)
            shown.append(self.colours(zoom(pixels) / 127.5 - 1))
        return shown


def _rounded(sums: Tensor) -> Tensor:
    """To the nearest byte, halves up."""
    return (sums + 0.5).floor().clamp(0, 255)


def _weights(before: int, after: int, own: Filter, mode: str) -> npt.NDArray[np.float64]:
    """``[after, before]``: the share that each old entry has in each new one, in steps of a power of two."""
    found = resize_matrix(before, after, True, mode, torch.float64).numpy()
    bits = _MOST_BITS
    if own == "torchvision":
        bits = next(
            n for n in range(_MOST_BITS) if n == _MOST_BITS - 1 or int(0.5 + found.max() * 2 ** (n + 1)) >= _LONGEST
        )
    return np.asarray(np.trunc(found * 2**bits + np.copysign(0.5, found)) / 2**bits)
