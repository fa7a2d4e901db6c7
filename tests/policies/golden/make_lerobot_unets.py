"""Run lerobot's ``diffusion`` on seeded weights, and write what it gives: ``lerobot_unet_VARIANT.npz``.

Not run by the tests. Needs lerobot 0.6.1 with diffusers, and torchvision; this repository has to be importable::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_unets

A torchvision whose compiled part does not fit the build of torch will do: its networks and transforms are Python.
"""

import sys
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from safetensors.torch import load_file

from .. import lerobot_unets
from ..vlas import pipelines

# What it says of operations that its compiled part would have.
sys.modules["torchvision._meta_registrations"] = ModuleType("torchvision._meta_registrations")

from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy  # noqa: E402

PROBES = (53, 4)


def main() -> None:
    """One file a variant."""
    torch.set_num_threads(1)
    for variant in lerobot_unets.VARIANTS:
        with TemporaryDirectory() as folder:
            numbers = run(lerobot_unets.save(variant, Path(folder) / "policy"), variant)
        path = Path(__file__).with_name(f"lerobot_unet_{variant}.npz")
        np.savez_compressed(path, **numbers)
        print(path, path.stat().st_size, "bytes")


@torch.no_grad()
def run(directory: Path, variant: str) -> dict[str, Any]:
    """Condition, single evaluations and executed actions of a policy, with noise from outside."""
    policy = DiffusionPolicy.from_pretrained(directory).eval()
    own = policy.state_dict()
    saved = load_file(directory / "model.safetensors")
    assert sorted(own) == sorted(saved), sorted(set(own) ^ set(saved))
    assert all(torch.equal(value, saved[name]) for name, value in own.items())
    before, after = pipelines(directory)
    given = {key: torch.from_numpy(value) for key, value in lerobot_unets.observation(variant).items()}
    batch = {key: value for key, value in before(given).items() if key.startswith("observation.")}
    if policy.config.image_features:
        images = [batch[key] for key in policy.config.image_features]
        batch["observation.images"] = torch.stack(images, dim=-4)
    condition = policy.diffusion._prepare_global_conditioning(batch)
    initial, draws = lerobot_unets.noise()
    start, order = torch.from_numpy(initial), iter(torch.from_numpy(draws))
    probes = [policy.diffusion.unet(start, torch.full((len(start),), t), global_cond=condition) for t in PROBES]
    scheduler = policy.diffusion.noise_scheduler
    module = import_module(type(scheduler).__module__)
    with patch.object(module, "randn_tensor", lambda *args, **kwargs: next(order)):
        action = after(policy.diffusion.generate_actions(batch, noise=start))
    return {
        "condition": condition.numpy(),
        "probe_t": np.array(PROBES),
        "probe_out": torch.stack(probes).numpy(),
        "action": action.numpy(),
        "timesteps": scheduler.timesteps.numpy(),
    }


if __name__ == "__main__":
    main()
