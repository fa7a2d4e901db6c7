"""Resizing images of bytes as OpenCV's ``INTER_AREA`` and ``INTER_LINEAR`` do, bit for bit.

With the first, what becomes smaller along both sides is averaged. Anything else is interpolated between two pixels
along each side, in whole numbers. Source: ``resize.cpp`` of OpenCV 4.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

_BITS = 11
"""After the point of a share of two pixels."""
_LITTLE = 1e-3
"""Of a pixel: what touches less of one leaves it out."""

Array = npt.NDArray[np.float64]


class _Pairs(NamedTuple):
    """Two old entries for each new one, and their shares, whole numbers of ``2**_BITS`` together, ``[after]``."""

    low: npt.NDArray[np.int64]
    high: npt.NDArray[np.int64]
    first: Array
    second: Array


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
        return _Between(*(_area_pairs(*pair) for pair in pairs))
    return (_Averaged if any(old % new for old, new in pairs) else _Whole)(before, after)


def linear_resized(before: tuple[int, int], after: tuple[int, int]) -> nn.Module:
    """The same with ``INTER_LINEAR``, which smooths nothing but what becomes half as large along both sides."""
    if before == after or all(old == 2 * new for old, new in zip(before, after, strict=True)):
        return area_resized(before, after)
    return _Between(_linear_pairs(before[0], after[0]), _linear_pairs(before[1], after[1], inside=True))


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
        # Sums are exact in float64. Their means are not: as OpenCV's, they are products of float32, a half too.
        sums = self.rows.to(torch.float64) @ pixels.to(torch.float64) @ self.columns.to(torch.float64)
        means = sums.to(torch.float32) * float(np.float32(1) / np.float32(self.count))
        return ((means + 0.5).floor() if self.up else means.round()).clamp(0, 255)


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
        part = _taken(pixels, own, axis) * share
        found = part if found is None else found + part
    assert found is not None, "there is a pixel"
    return found


class _Between(nn.Module):
    """Columns first, and then rows."""

    up: Tensor
    down: Tensor
    left: Tensor
    right: Tensor

    def __init__(self, rows: _Pairs, columns: _Pairs) -> None:
        super().__init__()
        self.places = [[each.tolist() for each in pairs[:2]] for pairs in (rows, columns)]
        up, down = (share[:, None] for share in rows[2:])
        _keep(self, up=up, down=down, left=columns.first, right=columns.second)

    def forward(self, pixels: Tensor) -> Tensor:
        (upper, lower), (left, right) = self.places
        # Sums of the first kind are exact in float32, and products of the second are not.
        wide = (_taken(pixels, left, -1) * self.left + _taken(pixels, right, -1) * self.right) / 2**4
        rows, down = wide.floor().to(torch.float64), self.down.to(torch.float64)
        first, second = _taken(rows, upper, -2) * self.up.to(torch.float64), _taken(rows, lower, -2) * down
        whole = (first / 2**16).floor() + (second / 2**16).floor()
        return ((whole + 2) / 4).floor().clamp(0, 255).to(torch.float32)


def _taken(pixels: Tensor, places: list[int], axis: int) -> Tensor:
    return pixels.index_select(axis, torch.tensor(places, device=pixels.device))


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


def _area_pairs(before: int, after: int) -> _Pairs:
    back = after / before
    scale, new = 1 / back, np.arange(after)
    low = np.floor(new * scale).astype(np.int64)
    share = ((new + 1) - (low + 1) * back).astype(np.float32)
    share = np.where(share <= 0, 0, share - np.floor(share))
    share = np.where(low >= before - 1, 0, share)
    return _rounded(low, share, before)


def _linear_pairs(before: int, after: int, inside: bool = False) -> _Pairs:
    """``inside``: whether what is beyond the middle of the first or the last entry is that entry alone."""
    at = ((np.arange(after) + 0.5) * (1 / (after / before)) - 0.5).astype(np.float32)
    low = np.floor(at).astype(np.int64)
    share = at - low.astype(np.float32)
    share = np.where((low < 0) | (low >= before - 1), 0, share) if inside else share
    return _rounded(low, share, before)


def _rounded(low: npt.NDArray[np.int64], share: npt.NDArray[np.float32], before: int) -> _Pairs:
    """``share`` is of the second of two neighbours; those that are not there are the nearest ones that are."""
    first, second = (np.rint(each.astype(np.float32) * 2**_BITS) for each in (np.float32(1) - share, share))
    near, far = (np.clip(each, 0, before - 1) for each in (low, low + 1))
    return _Pairs(near, far, first.astype(np.float64), second.astype(np.float64))
