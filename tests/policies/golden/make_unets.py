"""Run the original U-Nets on seeded weights, and write what they give: ``unet_VARIANT.npz``.

Not run by the tests. Needs real-stanford/diffusion_policy (5ba07ac), ARISE-Initiative/robomimic v0.2.0 and
YanjieZe/3D-Diffusion-Policy importable, and this repository. torchvision and pytorch3d need not be there::

    PYTHONPATH=path/to/diffusion_policy:path/to/robomimic:path/to/3D-Diffusion-Policy:. \\
        python -m tests.policies.golden.make_unets
"""

import sys
import typing
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock, patch

import diffusers.optimization
import diffusers.schedulers as schedulers
import numpy as np
import torch
from omegaconf import OmegaConf

from .. import unets
from .torchvision_stand_in import put_in_place

PROBED = (0, 17, 59)
"""Timesteps of single evaluations."""


def main() -> None:
    """One file a variant."""
    put_in_place()
    for name in ("Union", "Optional"):  # the original imports them from there; today's diffusers has them no longer
        setattr(diffusers.optimization, name, getattr(typing, name))
    sys.modules.setdefault("pytorch3d.ops", sys.modules.setdefault("pytorch3d", MagicMock()))  # imported, never called
    for variant in unets.VARIANTS:
        path = Path(__file__).with_name(f"unet_{variant}.npz")
        np.savez_compressed(path, **run(variant))
        print(path, path.stat().st_size, "bytes")


def made(settings: dict[str, Any]) -> Any:
    """What ``hydra.utils.instantiate`` makes of an entry of the configuration."""
    arguments = {key: _entry(value) for key, value in settings.items()}
    module, _, name = arguments.pop("_target_").rpartition(".")
    return getattr(schedulers if module == "diffusers.schedulers" else import_module(module), name)(**arguments)


def _entry(value: Any) -> Any:
    if isinstance(value, list):
        return [_entry(each) for each in value]
    return value if not isinstance(value, dict) else made(value) if "_target_" in value else OmegaConf.create(value)


@torch.no_grad()
def run(variant: str, of: ModuleType = unets) -> dict[str, Any]:
    """The original's actions, and single evaluations of its network, with noise from outside.

    Args:
        of: what makes configuration, weights, observations and noise of a variant; ``given`` is what the original
            observes, where that is something else.
    """
    settings, given = of.configuration(variant)["policy"], getattr(of, "given", of.observation)
    policy = made(settings)
    own, weights = policy.state_dict(), of.state_dict(variant)
    unknown = sorted(set(own) - set(weights))
    assert all(name.endswith(("_dummy_variable", "num_batches_tracked")) for name in unknown), unknown
    assert all(name.startswith("normalizer.") for name in set(weights) - set(own)), sorted(set(weights) - set(own))
    policy.load_state_dict(weights, strict=False)
    policy.eval()
    evaluations: list[tuple[tuple[Any, ...], dict[str, Any], Any]] = []
    policy.model.register_forward_hook(
        lambda module, args, kwargs, out: evaluations.append((args, kwargs, out)), with_kwargs=True
    )
    observation = {key: torch.from_numpy(value) for key, value in given(variant).items()}
    steps = settings["n_action_steps"] if settings.get("pred_action_steps_only") else settings["horizon"]
    initial, draws = of.noise((steps, policy.model.final_conv[1].out_channels))
    order = iter(torch.from_numpy(draws))
    schedule = type(policy.noise_scheduler).__module__
    with (
        patch("torch.randn", lambda *args, **kwargs: torch.from_numpy(initial).clone()),
        patch(f"{schedule}.randn_tensor", lambda *args, **kwargs: next(order)),
    ):
        result = policy.predict_action(observation)
    # The network was called on the first sample, with the observation in it; once more on this, at other timesteps.
    positional, given, _ = evaluations[0]
    given = dict(zip(("sample", "timestep"), positional, strict=False)) | given
    evaluations.clear()
    for timestep in PROBED:
        policy.model(**(given | {"timestep": torch.tensor(timestep)}))
    return {
        "action": result["action"].numpy(),
        "action_pred": result["action_pred"].numpy(),
        "timesteps": policy.noise_scheduler.timesteps.numpy(),
        "probe_t": np.array(PROBED),
        "probe_out": np.stack([out.numpy() for *_, out in evaluations]),
    }


if __name__ == "__main__":
    main()
