"""Run the original Improved 3D Diffusion Policy on seeded weights, and write what it gives: ``idp3_VARIANT.npz``.

Not run by the tests. Needs YanjieZe/Improved-3D-Diffusion-Policy (f5b27fa) with its third_party/r3m, einops, omegaconf,
termcolor, and torchvision, of which no compiled part is used, importable, and this repository::

    PYTHONPATH=path/to/Improved-3D-Diffusion-Policy:path/to/third_party/r3m:torchvision-0.28.0:. \\
        python -m tests.policies.golden.make_idp3

What the original draws at random of an observation is here what is compiled: evenly spaced points, the centre of an
image, which is neither turned nor recoloured.
"""

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, patch

import numpy as np
import torch

from tests.families.golden.originals import package

from .. import idp3s
from .make_unets import run


def main() -> None:
    """One file a variant."""
    for name in ("timm", "gdown", "hydra"):  # imported; what is called of them loads weights
        sys.modules[name] = MagicMock()
    root = Path(find_spec("torchvision").submodule_search_locations[0])  # type: ignore[union-attr,index]
    package("torchvision", root)
    package("torchvision.models", root / "models")
    models, transforms = (sys.modules["torchvision.models"], import_module("torchvision.transforms"))
    vars(sys.modules["torchvision"]).update(models=models, transforms=transforms)
    vars(models).update(resnet18=import_module("torchvision.models.resnet").resnet18)
    with (
        patch.object(import_module("r3m"), "load_r3m", load_r3m),
        patch.object(transforms.RandomCrop, "get_params", staticmethod(centre)),
        patch.object(transforms.RandomRotation, "get_params", staticmethod(lambda degrees: 0.0)),
        patch.object(transforms.ColorJitter, "get_params", staticmethod(no_other_colours)),
        patch("torch.randperm", evenly),
    ):
        for variant in idp3s.VARIANTS:
            path = Path(__file__).with_name(f"idp3_{variant}.npz")
            np.savez_compressed(path, **run(variant, idp3s))
            print(path, path.stat().st_size, "bytes")


def load_r3m(name: str, pretrained: bool) -> Any:
    """As the original makes it, without the weights that it downloads."""
    network = import_module("r3m").R3M(device="cpu", lr=1e-4, hidden_dim=8, size=int(name[-2:]), langweight=0.0)
    return torch.nn.DataParallel(network) if pretrained else network


def centre(image: torch.Tensor, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Top, left, height and width of the crop."""
    height, width = size
    return (image.shape[-2] - height) // 2, (image.shape[-1] - width) // 2, height, width


def no_other_colours(*ranges: list[float] | None) -> tuple[Any, ...]:
    """An order of the changes, and a factor of each that is asked for; none of the hue, which 0 only rounds."""
    return torch.arange(4), *(each and 1.0 for each in ranges[:3]), None


def evenly(count: int) -> torch.Tensor:
    """An order of so many points whose first 20, as many as are configured, are spaced evenly; then the others."""
    first = torch.arange(min(20, count)) * count // min(20, count)
    others = [i for i in range(count) if i not in first.tolist()]
    return torch.cat((first, torch.tensor(others, dtype=torch.int64)))


if __name__ == "__main__":
    main()
