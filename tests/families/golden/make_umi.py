"""Run UMI's policies at tiny sizes on seeded weights, and write what they give: ``umi.npz``.

Not run by the tests. Needs a clone of real-stanford/universal_manipulation_interface (d095ba9), timm 0.9.7, einops
0.6.1, and torchvision, of which no compiled part is used::

    pip install --no-deps --target timm-0.9.7 timm==0.9.7
    pip install --no-deps --target einops einops==0.6.1
    PYTHONPATH=timm-0.9.7:einops:torchvision-0.28.0 python -m tests.families.golden.make_umi path/to/the/clone
"""

import importlib
import importlib.util
import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from tests.policies import umis

from .originals import Arrays, absent, generator, noise_from, package, timm

_TIMM = "0.9.7"


def run(folder: Path) -> dict[str, Arrays]:
    """Of each variant the actions of a call, in which everything that is drawn is in its middle."""
    prepare(folder)
    with middle():
        found = {variant: of(variant) for variant in umis.VARIANTS}
    return {"umi": {f"{variant}.{name}": value for variant, made in found.items() for name, value in made.items()}}


def prepare(folder: Path) -> None:
    """Make the original importable, with networks of timm that are small."""
    sys.path.insert(0, str(folder))
    importlib.import_module("diffusers").DDIMScheduler  # noqa: B018 - before parts are there of what it looks for
    root = Path(importlib.util.find_spec("torchvision").submodule_search_locations[0])  # type: ignore[union-attr,index]
    for name in ("torchvision", "torchvision.transforms"):
        package(name, root / name.partition(".")[2])
    absent("torchvision.extension", "torchvision.ops", "torchvision.io", "torchvision.models")
    transforms = importlib.import_module("torchvision.transforms.transforms")
    sys.modules["torchvision.transforms"].__dict__.update(vars(transforms))
    sys.modules["torchvision"].__dict__["transforms"] = sys.modules["torchvision.transforms"]
    absent("zarr", "numba", "h5py", "threadpoolctl")
    timm(_TIMM)
    models = importlib.import_module("timm")
    create = models.create_model

    def small(model_name: str, pretrained: bool, **settings: Any) -> Any:
        sizes = dict(umis.SMALL[next(kind for kind in umis.SMALL if model_name.startswith(kind))])
        if model_name.startswith("vit"):
            sizes["img_size"] = small.size  # type: ignore[attr-defined]
        return create(model_name.partition(".")[0], pretrained=False, **sizes, **settings)

    models.__dict__["create_model"] = small
    models.__dict__["small"] = small


@contextmanager
def middle() -> Iterator[None]:
    """Within it torchvision's transforms draw the middle of what they may draw."""
    seen = sys.modules["torchvision.transforms"]  # the one that ``prepare`` put there

    def crop(image: torch.Tensor, size: tuple[int, int]) -> tuple[int, ...]:
        margins = [n - m for n, m in zip(image.shape[-2:], size, strict=True)]
        return (*(round(n / 2) for n in margins), *size)

    with ExitStack() as stack:
        for name, drawn in (
            ("RandomCrop", crop),
            ("ColorJitter", lambda *ranges: (torch.arange(4), *(None if r is None else sum(r) / 2 for r in ranges))),
            ("RandomRotation", lambda degrees: sum(degrees) / 2),
        ):
            stack.enter_context(patch.object(getattr(seen, name), "get_params", staticmethod(drawn)))
        yield


def made(settings: dict[str, Any]) -> Any:
    """What ``hydra.utils.instantiate`` makes of an entry of the configuration."""

    def value(given: Any) -> Any:
        if isinstance(given, list):
            return [value(each) for each in given]
        if not isinstance(given, dict):
            return given
        return made(given) if "_target_" in given else _Entries({key: value(each) for key, each in given.items()})

    arguments = {name: value(each) for name, each in settings.items()}
    module, _, name = arguments.pop("_target_").rpartition(".")
    return getattr(importlib.import_module(module), name)(**arguments)


class _Entries(dict[str, Any]):
    """Settings that have attributes, as omegaconf's have."""

    __getattr__ = dict.__getitem__


def pictured(settings: dict[str, Any]) -> int:
    """Pixels along a side of what a network is shown."""
    encoder = settings["obs_encoder"]
    size = next(each["shape"][1] for each in encoder["shape_meta"]["obs"].values() if each.get("type") == "rgb")
    for each in encoder["transforms"] or []:
        size = each.get("size", size)
    return int(size)


def of(variant: str) -> Arrays:
    """What one policy gives."""
    settings = umis.configuration(variant)["policy"]
    sys.modules["timm"].__dict__["small"].size = pictured(settings)
    policy = made(settings)
    unset = ("_dummy_variable", "num_batches_tracked")
    shapes = {name: list(value.shape) for name, value in policy.state_dict().items() if not name.endswith(unset)}
    cameras = sorted(policy.obs_encoder.rgb_keys) if settings["obs_encoder"].get("share_rgb_model") else []
    left = policy.load_state_dict(umis.draw(shapes, cameras) | umis.normalizer(variant), strict=False)
    assert all(name.endswith(unset) for name in left.missing_keys), left.missing_keys
    assert all(name.startswith("normalizer.") for name in left.unexpected_keys), left.unexpected_keys
    policy.eval()
    observed = {key: torch.from_numpy(value) for key, value in umis.observation(variant).items()}
    told = {"fixed_action_prefix": torch.from_numpy(umis.committed())}
    found: Arrays = {"shapes": np.frombuffer(json.dumps(shapes).encode(), np.uint8)}
    for name, given in {"action": {}, "prefixed": told if "inpaint_fixed_action_prefix" in settings else None}.items():
        if given is not None:
            with noise_from(umis.noise()):
                found[name] = policy.predict_action(observed, **given)["action_pred"].numpy()
    return found


main = generator(run, "d095ba9", *(f"diffusion_policy/{name}" for name in ("policy", "model", "common")))

if __name__ == "__main__":
    main()
