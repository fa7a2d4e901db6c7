"""Resizing and centre-cropping images as torchvision does, as matrix products: without torchvision, and exportable."""

import torch
from torch import nn
from torch.nn import functional

from ttscompile.errors import CheckpointError


class ResizeCrop(nn.Module):
    """Resize to a fixed size, then a crop of the centre.

    The resize of a float image is linear and separable: ``rows @ image @ columns``. Both matrices are what the resize
    makes of the unit matrix, so that whatever it does at the border is in them; of both only the part that the crop
    keeps is stored.

    Args:
        resize: (height, width); None for none.
        crop: (height, width) within the resized image; None for all of it.
        antialias: whether pixels of a smaller image are averages of all that they stand for, as torchvision resizes
            tensors from its version 0.17 on.
        mode: ``bilinear`` or ``bicubic``.
    """

    rows: torch.Tensor
    columns: torch.Tensor

    def __init__(
        self,
        height: int,
        width: int,
        resize: tuple[int, int] | None = None,
        crop: tuple[int, int] | None = None,
        antialias: bool = True,
        mode: str = "bilinear",
    ) -> None:
        super().__init__()
        whole = resize or (height, width)
        self.size = crop or whole
        if self.size[0] > whole[0] or self.size[1] > whole[1]:
            raise CheckpointError(f"the crop {self.size} is larger than the image, {whole}.")
        # Python rounds halves to even, and so does torchvision's centre crop.
        self.top, self.left = (round((n - m) / 2.0) for n, m in zip(whole, self.size, strict=True))
        self.resized = resize is not None and resize != (height, width)
        if self.resized:
            sides = zip((height, width), whole, strict=True)
            rows, columns = (resize_matrix(*each, antialias, mode, torch.float32) for each in sides)
            self.register_buffer("rows", rows[self.top : self.top + self.size[0]].clone(), persistent=False)
            columns = columns[self.left : self.left + self.size[1]]
            self.register_buffer("columns", columns.t().contiguous(), persistent=False)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """``[N, C, H, W]`` -> ``[N, C, *size]``."""
        if self.resized:
            return torch.matmul(torch.matmul(self.rows, images), self.columns)
        height, width = self.size
        return images[:, :, self.top : self.top + height, self.left : self.left + width]


def resize_matrix(before: int, after: int, antialias: bool, mode: str, dtype: torch.dtype) -> torch.Tensor:
    """``[after, before]``: what resizing along one axis does; see ``ResizeCrop``."""
    unit = torch.eye(before, dtype=dtype)[None, None]
    rows = functional.interpolate(unit, (after, before), mode=mode, antialias=antialias, align_corners=False)
    return rows[0, 0]
