"""What GR00T's own code does to a picture before its backbone sees it: padded, resized, cropped, resized again.

All is done to bytes, as albumentations (with OpenCV) or torchvision does it. Source: ``image_augmentations.py`` of
NVIDIA/Isaac-GR00T.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

from torch import Tensor, nn
from torch.nn import functional

from ttscompile.frontends.settings import Settings

from .lerobot.config import MOST_PIXELS
from .lerobot.qwen3_vl import Resizing
from .lerobot.resized_bytes import resized
from .opencv_area import area_resized

SIZE = "image_size"
"""An entry of ``config.json`` that the original does not know."""
_EDGE, _SHARE = 256, 0.95

Size = tuple[int, int]


class _Way(NamedTuple):
    """How pictures are resized.

    Attributes:
        opencv: whether albumentations does it; else torchvision.
        padded: whether they become squares first, with black beside them.
        edge: pixels along the shorter side of a picture that keeps its proportions; None where it does not.
        target: height and width of one that does not.
        crop: height and width of what is kept, or the share of both sides.
    """

    opencv: bool
    padded: bool
    edge: int | None
    target: Size
    crop: Size | float

    def zoomed(self, size: Size) -> Size:
        """Height and width of a picture of this size, resized."""
        if self.edge is None:
            return self.target
        scale = self.edge / min(size)
        return (round(size[0] * scale), round(size[1] * scale)) if scale != 1 else size

    def cropped(self, size: Size) -> tuple[Size, Size]:
        """Where what is kept begins, and its size."""
        if isinstance(self.crop, float):
            height, width = (max(1, int(side * self.crop)) for side in size)
            return ((size[0] - height) // 2, (size[1] - width) // 2), (height, width)
        height, width = self.crop
        return (round((size[0] - height) / 2), round((size[1] - width) / 2)), self.crop


@dataclass(frozen=True)
class Pictures:
    """Of every camera, by name.

    Attributes:
        given: height and width of its pictures.
        seen: as the backbone sees them.
    """

    given: Mapping[str, Size]
    seen: Mapping[str, Size]
    way: _Way

    def network(self, frames: int) -> nn.Module:
        """Pictures in -1..1, of all cameras in turn and so many frames, to what the backbone sees of them."""
        return _Seen([_Camera(size, self.seen[key], self.way) for key, size in self.given.items()], frames)


def read_pictures(base: Settings, own: Settings, cameras: Sequence[str], last: Resizing) -> Pictures:
    """Of the entries of the model and of the processor.

    Args:
        last: what the backbone's own processor does afterwards.
    """
    opencv, target = own.flag("use_albumentations", False), own.size("image_target_size", None, MOST_PIXELS)
    edge, share = own.values.get("shortest_image_edge", _EDGE), own.values.get("crop_fraction", _SHARE)
    crop = own.size("image_crop_size", None, MOST_PIXELS)
    kept: Size | float | None = crop
    if opencv and edge is not None:
        edge = own.number("shortest_image_edge", _EDGE, MOST_PIXELS)
    if opencv:
        kept = crop[0] / target[0] if share is None and crop and target else share
        if type(kept) not in (int, float) or not 0 < kept <= 1:
            raise own.refusal("crop_fraction", "a share of a side, or null with image_crop_size and image_target_size")
        kept = float(kept)
    else:
        edge = None
    if target is None and edge is None:
        raise own.refusal("image_target_size", "height and width")
    if kept is None or (isinstance(kept, tuple) and target and any(n > m for n, m in zip(kept, target, strict=True))):
        raise own.refusal("image_crop_size", f"height and width, {target} at most")
    way = _Way(opencv, own.flag("letter_box_transform", False), edge, target or (_EDGE, _EDGE), kept)
    side = edge or way.target[0]
    given = read_sizes(base, cameras, (side, side))
    large = {key: way.zoomed(_squared(size, way.padded)) for key, size in given.items()}
    shown = {key: way.zoomed(way.cropped(size)[1]) for key, size in large.items()}
    if max(max(size) for size in (*large.values(), *shown.values())) > MOST_PIXELS:
        raise base.refusal(SIZE, f"{MOST_PIXELS} pixels a side at most once they are resized; they have {large}")
    if len(set(shown.values())) > 1:
        raise base.refusal(SIZE, f"pictures that have one size once they are resized; they have {shown}")
    return Pictures(given, {key: last(*size) for key, size in shown.items()}, way)


def read_sizes(base: Settings, cameras: Sequence[str], default: Size) -> dict[str, Size]:
    """Height and width of each camera's pictures, which the original does not save."""
    found = base.values.get(SIZE, list(default))
    by_name = found if isinstance(found, dict) else dict.fromkeys(cameras, found)
    if not set(by_name) >= set(cameras):
        raise base.refusal(SIZE, f"[height, width], or one for each of {', '.join(cameras)}")
    own = Settings(by_name, f"{base.where}{SIZE}.")
    return {key: own.size(key, None, MOST_PIXELS) or default for key in cameras}


def _squared(size: Size, padded: bool) -> Size:
    return (max(size), max(size)) if padded else size


class _Camera(nn.Module):
    """Pixels in 0..255 ``[B, 3, H, W]`` to what the backbone sees, in -1..1."""

    def __init__(self, size: Size, seen: Size, way: _Way) -> None:
        super().__init__()
        whole = _squared(size, way.padded)
        down, across = (n - m for n, m in zip(whole, size, strict=True))
        self.pad = (across // 2, across - across // 2, down // 2, down - down // 2)
        zoomed = way.zoomed(whole)
        (self.top, self.left), (self.height, self.width) = way.cropped(zoomed)
        kept = self.height, self.width
        shown = way.zoomed(kept)
        self.first, self.second = (_resized(*pair, way.opencv) for pair in ((whole, zoomed), (kept, shown)))
        self.last = resized(shown, seen, "torchvision") if shown != seen else nn.Identity()

    def forward(self, pixels: Tensor) -> Tensor:
        """See the class."""
        if any(self.pad):
            pixels = functional.pad(pixels, self.pad)
        rows, columns = slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)
        return self.last(self.second(self.first(pixels)[..., rows, columns])) / 127.5 - 1  # type: ignore[no-any-return]


class _Seen(nn.Module):
    def __init__(self, cameras: list[_Camera], frames: int) -> None:
        super().__init__()
        self.cameras, self.frames = nn.ModuleList(cameras), frames

    def forward(self, images: list[Tensor]) -> list[Tensor]:
        cameras = chain.from_iterable([self.cameras] * self.frames)
        return [camera(as_bytes(image)) for camera, image in zip(cameras, images, strict=True)]


def as_bytes(image: Tensor) -> Tensor:
    """Pixels in -1..1 as whole numbers in 0..255."""
    return ((image + 1) * 127.5).round().clamp(0, 255)


def _resized(before: Size, after: Size, opencv: bool) -> nn.Module:
    if before == after:
        return nn.Identity()
    return area_resized(before, after) if opencv else resized(before, after, "torchvision", "bilinear")
