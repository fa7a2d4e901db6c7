"""What UMI and iDP3 do to a picture before their networks see it, with the middle of all that they draw.

The original crops, turns and recolours its pictures at random in training, and at every call afterwards, too:
torchvision's transforms do not know that a policy is evaluated. Here a crop is the one in the middle, no picture is
turned, and no colour changes, which is the middle of what the original draws.

Source: ``transforms`` of ``TimmObsEncoder`` of real-stanford/universal_manipulation_interface at d095ba9, and
torchvision 0.16, which it asks for.
"""

import warnings
from collections.abc import Collection, Mapping
from typing import Any

import torch
from torch import nn

from ttscompile.frontends.settings import Settings

from ..networks.image_geometry import ResizeCrop
from .images import COLOURS
from .parts import MOST_PIXELS

Size = tuple[int, int]

_MIDDLE: Mapping[str, Mapping[str, float]] = {
    "ColorJitter": {"brightness": 1, "contrast": 1, "saturation": 1, "hue": 0},
    "RandomRotation": {"degrees": 0},
    "RandomPerspective": {},
    "ElasticTransform": {},
}
"""Transforms that change nothing in the middle of their ranges; and where that is, by setting."""
_OTHERS: Mapping[str, frozenset[str]] = {
    "ColorJitter": frozenset(),
    "RandomRotation": frozenset({"expand", "interpolation", "fill"}),
    "RandomPerspective": frozenset({"distortion_scale", "p", "interpolation", "fill"}),
    "ElasticTransform": frozenset({"alpha", "sigma", "interpolation", "fill"}),
    "RandomCrop": frozenset({"size"}),
    "CenterCrop": frozenset({"size"}),
    "Resize": frozenset({"size", "antialias"}),
    "Normalize": frozenset({"mean", "std"}),
}
"""Their other settings, and those of the other transforms."""


def tell_of_draws(settings: Settings, drawn: Collection[str]) -> None:
    """Warn that the original draws what the compiled policy does not, if it does.

    Args:
        settings: of the encoder.
        drawn: names of the transforms; see ``Pictures``.
    """
    if drawn:
        warnings.warn(
            f"{settings.where}transforms: the original draws {', '.join(sorted(set(drawn)))} anew at every call, on the"
            " robot, too. The compiled policy takes the middle of what is drawn: the crop in the middle, nothing"
            " turned, and no other colours.",
            stacklevel=3,
        )


class Colours(nn.Module):
    """Every colour, scaled and moved: ``[N, 3, H, W]`` to the same; and kept within 0..1, if that is asked for."""

    scale: torch.Tensor
    offset: torch.Tensor

    def __init__(self, scale: list[float], offset: list[float], clamped: bool = False) -> None:
        super().__init__()
        self.clamped = clamped
        for name, values in (("scale", scale), ("offset", offset)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32).reshape(-1, 1, 1), persistent=False)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """See the class."""
        changed = images * self.scale + self.offset
        return changed.clamp(0, 1) if self.clamped else changed


class Pictures:
    """The steps from a camera's pictures to what its network is given, one after the other.

    Attributes:
        steps: modules, ``[N, 3, H, W]`` to ``[N, 3, *size]``.
        size: height and width of what the last of them gives.
        drawn: names of those that draw something at each call of the original.
    """

    def __init__(self, settings: Settings, shape: Size, normalizer: tuple[float, float]) -> None:
        self.size, self.drawn, self._whole = shape, list[str](), normalizer == (1.0, 0.0)
        self.steps: list[nn.Module] = [] if self._whole else [Colours([normalizer[0]], [normalizer[1]])]
        values = settings.values.get("transforms")
        if values is None:
            return
        if not isinstance(values, list) or not values or not all(isinstance(each, dict) for each in values):
            raise settings.refusal("transforms", "transforms by name or null")
        for number, each in enumerate(values):
            own = Settings(each, f"{settings.where}transforms[{number}].", settings.remedy)
            if number == 0 and "_target_" not in each:
                self._first(own, shape[0])
            else:
                self._add(own, str(each.get("_target_")).rpartition(".")[2])

    def _first(self, settings: Settings, height: int) -> None:
        """A square crop, brought back to the height of the picture."""
        settings.choice("type", "RandomCrop")
        ratio = settings.values.get("ratio")
        if not isinstance(ratio, int | float) or not 0 < ratio <= 1 or (side := int(height * ratio)) < 1:
            raise settings.refusal("ratio", "a share of the picture")
        self._crop(settings, (side, side), drawn=True)
        self._resize((height, height), antialias=True)

    def _add(self, settings: Settings, name: str) -> None:
        if name not in _OTHERS:
            raise settings.error(f"_target_ is {name!r:.80}; expected one of torchvision's {', '.join(_OTHERS)}")
        unknown = sorted(set(settings.values) - _OTHERS[name] - {*_MIDDLE.get(name, {}), "_target_"})
        if unknown:
            raise settings.error(f"{name} has settings that are not known here: {', '.join(unknown)}")
        if name in _MIDDLE:
            self._middle(settings, name)
        elif name == "Normalize":
            mean, deviation = (_numbers(settings, each) for each in ("mean", "std"))
            offsets = [-m / n for m, n in zip(mean, deviation, strict=True)]
            self.steps.append(Colours([1 / n for n in deviation], offsets))
            self._whole = False
        elif name == "Resize":
            height, width = self.size
            size = settings.values.get("size")
            if type(size) is int and size > 0:  # of the shorter side, as torchvision has it
                long = int(size * max(self.size) / min(self.size))
                size = [size, long] if height <= width else [long, size]
            self._resize(_size(settings, size), settings.flag("antialias", False))
        else:
            size = settings.values.get("size")
            self._crop(settings, _size(settings, [size, size] if type(size) is int else size), name == "RandomCrop")

    def _middle(self, settings: Settings, name: str) -> None:
        """What changes nothing, if nothing is in its ranges."""
        if name == "RandomRotation" and settings.flag("expand", False):
            raise settings.error("expand is true; expected false: turned pictures have the size of the others")
        for key, nothing in _MIDDLE[name].items():
            value = settings.values.get(key, nothing)
            ends = value if isinstance(value, list) else [nothing, nothing] if _number(value) else []
            if len(ends) != 2 or not all(map(_number, ends)) or not ends[0] <= nothing <= ends[1]:
                raise settings.refusal(key, f"a number, or a range around {nothing:g}, where {name} changes nothing")
        self.drawn.append(name)
        if name == "ColorJitter" and not self._whole:
            self.steps.append(Colours([1.0], [0.0], clamped=True))  # as the original keeps colours within 0..1

    def _crop(self, settings: Settings, size: Size, drawn: bool) -> None:
        if size[0] > self.size[0] or size[1] > self.size[1]:
            found = f"a crop of {size[0]} x {size[1]} from pictures of {self.size[0]} x {self.size[1]}"
            raise settings.error(f"{found}; expected one that is no larger; the original refuses this, too")
        self.drawn += ["RandomCrop"] * (drawn and size != self.size)
        self.steps.append(ResizeCrop(*self.size, crop=size))
        self.size = size

    def _resize(self, size: Size, antialias: bool) -> None:
        self.steps.append(ResizeCrop(*self.size, resize=size, antialias=antialias))
        self.size = size


def _size(settings: Settings, value: Any) -> Size:
    found = Settings({"size": value}, settings.where, settings.remedy).size("size", [], MOST_PIXELS)
    assert found is not None or value is None
    if found is None:
        raise settings.refusal("size", "a number of pixels, or [height, width]")
    return found


def _number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < MOST_PIXELS


def _numbers(settings: Settings, name: str) -> list[float]:
    """One for each colour, and no deviation of 0."""
    value: Any = settings.values.get(name)
    whole = isinstance(value, list) and len(value) == COLOURS and all(map(_number, value))
    if not whole or (name == "std" and min(value) <= 0):
        raise settings.refusal(name, "a number for each of the three colours")
    return [float(n) for n in value]
