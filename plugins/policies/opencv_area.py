"""Resizing images of bytes as OpenCV's ``INTER_AREA`` does, bit for bit.

What becomes smaller along both sides is averaged. Anything else is interpolated between two pixels along each side, in
whole numbers. Source: ``resize.cpp`` of OpenCV 4.
"""

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

_BITS = 11
"""After the point of a share of two pixels."""
_LITTLE = 1e-3
"""Of a pixel: what touches less of one leaves it out."""

Array = npt.NDArray[np.float64]


def area_resized(before: tuple[int, int], after: tuple[int, int]) -> nn.Module:
    """What makes of images ``[..., H, W]`` of whole numbers in 0..255, as float32, others of another height and width.

    Args:
        before: height and width.
        after: likewise.
    """
    if before == after:
        return nn.Identity()
    pairs = list(zip(before, after, strict=True))
    if any(new > old for old, new in pairs):
        return _Between(before, after)
    return (_Averaged if any(old % new for old, new in pairs) else _Whole)(before, after)


class _Whole(nn.Module):
    """Means of as many old rows and columns for each new one."""

    rows: Tensor
    columns: Tensor

    def __init__(self, before: tuple[int, int], after: tuple[int, int]) -> None:
        super().__init__()
        rows, columns = (np.repeat(np.eye(new), old // new, 1) for old, new in zip(before, after, strict=True))
        parts = [old // new for old, new in zip(before, after, strict=True)]
        # Halves go up where two rows and two columns become one, and elsewhere to the even number.
        self.up, self.count = parts == [2, 2], parts[0] * parts[1]
        _keep(self, rows=rows, columns=columns.T)

    def forward(self, pixels: Tensor) -> Tensor:
        # Sums are exact in float64, so that a half is one.
        means = self.rows.to(torch.float64) @ pixels.to(torch.float64) @ self.columns.to(torch.float64) / self.count
        return ((means + 0.5).floor() if self.up else means.round()).clamp(0, 255).to(torch.float32)


class _Averaged(nn.Module):
    """Means of parts of pixels, added in float32 in the order of OpenCV's: a half goes where that rounds it to."""

    row_shares: Tensor
    column_shares: Tensor

    def __init__(self, before: tuple[int, int], after: tuple[int, int]) -> None:
        super().__init__()
        (at, shares), (along, own) = (_shares(old, new) for old, new in zip(before, after, strict=True))
        self.rows, self.columns = at, along
        _keep(self, row_shares=shares[:, :, None], column_shares=own)

    def forward(self, pixels: Tensor) -> Tensor:
        wide = _added(pixels, self.columns, self.column_shares, -1)
        return _added(wide, self.rows, self.row_shares, -2).round().clamp(0, 255)


def _added(pixels: Tensor, places: list[list[int]], shares: Tensor, axis: int) -> Tensor:
    """Sums of as many old rows or columns as the largest mean has, one after the other."""
    found: Tensor | None = None
    for own, share in zip(places, shares, strict=True):
        part = pixels.index_select(axis, torch.tensor(own, device=pixels.device)) * share
        found = part if found is None else found + part
    assert found is not None, "there is a pixel"
    return found


class _Between(nn.Module):
    first: Tensor
    second: Tensor
    shares: Tensor
    columns: Tensor

    def __init__(self, before: tuple[int, int], after: tuple[int, int]) -> None:
        super().__init__()
        (low, high, share), across = _pairs(before[0], after[0]), _pairs(before[1], after[1])
        columns = across[0] * (2**_BITS - across[2][:, None]) + across[1] * across[2][:, None]
        _keep(self, first=low, second=high, shares=share[:, None], columns=columns.T)

    def forward(self, pixels: Tensor) -> Tensor:
        wide = (pixels.to(torch.float64) @ self.columns.to(torch.float64) / 2**4).floor()
        second = self.shares.to(torch.float64)
        pairs = ((self.first, 2**_BITS - second), (self.second, second))
        sums = [((each.to(torch.float64) @ wide) * share / 2**16).floor() for each, share in pairs]
        return ((sums[0] + sums[1] + 2) / 4).floor().clamp(0, 255).to(torch.float32)


def _keep(module: nn.Module, **values: Array) -> None:
    for name, value in values.items():
        made = torch.tensor(np.ascontiguousarray(value), dtype=torch.float32, device="cpu")
        module.register_buffer(name, made, persistent=False)


def _shares(before: int, after: int) -> tuple[list[list[int]], Array]:
    """Which old entries each new one is the mean of, ``[most, after]``, and their shares; of none it is 0."""
    scale, found = 1 / (after / before), list[list[tuple[int, float]]]()
    for new in range(after):
        start = new * scale
        stop, whole = start + scale, min(scale, before - start)
        last = min(int(stop), before - 1)
        first = min(math.ceil(start), last)
        parts = [(first - 1, first - start)] if first - start > _LITTLE else []
        parts += [(old, 1.0) for old in range(first, last)]
        parts += [(last, min(stop - last, 1.0, whole))] if stop - last > _LITTLE else []
        found.append([(old, part / whole) for old, part in parts])
    most = max(map(len, found))
    padded = [own + [(0, 0.0)] * (most - len(own)) for own in found]
    places = [[own[part][0] for own in padded] for part in range(most)]
    return places, np.array([[own[part][1] for own in padded] for part in range(most)])


def _pairs(before: int, after: int) -> tuple[Array, Array, Array]:
    """``[after, before]`` twice, a 1 where each of two old entries is; and the share of the second, a whole number."""
    back = after / before
    scale, new = 1 / back, np.arange(after)
    low = np.floor(new * scale).astype(np.int64)
    share = ((new + 1) - (low + 1) * back).astype(np.float32)
    share = np.where(share <= 0, 0, share - np.floor(share))
    share = np.where(low >= before - 1, 0, share)
    low = np.minimum(low, before - 1)
    high = np.minimum(low + 1, before - 1)
    unit = np.eye(before)
    return unit[low], unit[high], np.rint(share * 2**_BITS).astype(np.float64)
