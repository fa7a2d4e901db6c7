"""Run Streaming Diffusion Policy on seeded weights, call after call, and write what it gives: ``streaming.npz``.

Not run by the tests. Needs a clone of Streaming-Diffusion-Policy/streaming_diffusion_policy (922271e), omegaconf,
ARISE-Initiative/robomimic v0.2.0 importable, and einops::

    pip install --no-deps --target einops einops==0.8.2
    PYTHONPATH=einops:path/to/robomimic python -m tests.families.golden.make_streaming path/to/the/clone
"""

import importlib
import sys
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, patch

import diffusers.utils
import numpy as np
import torch

from tests.policies import streams
from tests.policies.golden.torchvision_stand_in import put_in_place

from .originals import Arrays, generator

_ABSENT = ("zarr", "numcodecs", "diffusion_policy.dataset", "diffusion_policy.dataset.pusht_dataset")


def made(settings: dict[str, Any]) -> Any:
    """What ``hydra.utils.instantiate`` makes of an entry of the configuration."""
    arguments = {
        name: made(value) if isinstance(value, dict) and "_target_" in value else value
        for name, value in settings.items()
    }
    module, _, name = arguments.pop("_target_").rpartition(".")
    return getattr(importlib.import_module(module), name)(**arguments)


def run(folder: Path) -> dict[str, Arrays]:
    """Of each variant the actions of three consecutive calls, and what its network was told and gave at first."""
    sys.path.insert(0, str(folder))
    put_in_place()
    for name in (*_ABSENT, "diffusion_policy.dataset.pusht_image_dataset"):  # imported, never called
        sys.modules[name] = MagicMock()
    # Today's diffusers has the one name no longer, and refuses what its version 0.12 was to have lost.
    diffusers.utils.__dict__.setdefault("_COMPATIBLE_STABLE_DIFFUSION_SCHEDULERS", [])
    diffusers.utils.__dict__["deprecate"] = lambda *names, **settings: None
    return {
        "streaming": {f"{variant}.{name}": value for variant in streams.VARIANTS for name, value in of(variant).items()}
    }


def of(variant: str) -> Arrays:
    """What one policy gives."""
    policy = made(streams.configuration(variant)["policy"])
    given = streams.network(variant) | streams.normalizer(variant)
    left = policy.load_state_dict(given, strict=False)
    unset = ("_dummy_variable", "num_batches_tracked")
    assert all(name.endswith(unset) for name in left.missing_keys), left.missing_keys
    assert all(name.startswith("normalizer.") for name in left.unexpected_keys), left.unexpected_keys
    policy.eval()
    evaluations: list[tuple[Any, Any]] = []
    policy.model.register_forward_hook(lambda module, args, out: evaluations.append((args, out)))
    order = iter(torch.from_numpy(streams.draws(variant)))

    def drawn(*shape: Any, size: Any = None, **settings: Any) -> torch.Tensor:
        """The next one, of which as many steps are taken as are asked for."""
        return next(order)[:, : (size or shape[0])[1]].clone()

    actions, whole = [], []
    with patch("torch.randn", drawn):
        for observed in streams.observations(variant):
            result = policy.predict_action({key: torch.from_numpy(value) for key, value in observed.items()})
            actions.append(result["action"].numpy())
            whole.append(result["action_pred"].clone().numpy())
    return {
        "action": np.stack(actions),
        "action_pred": np.stack(whole),
        "told": np.stack([args[1][0].numpy() for args, _ in evaluations]),
        "first_out": evaluations[0][1].numpy(),
    }


main = generator(run, "922271e", *(f"diffusion_policy/{name}" for name in ("policy", "model", "common", "dataset")))

if __name__ == "__main__":
    main()
