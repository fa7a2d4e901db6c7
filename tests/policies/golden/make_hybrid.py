"""Run the original image transformer on seeded weights, and write what it gives: ``hybrid_VARIANT.npz``.

Not run by the tests. Needs real-stanford/diffusion_policy (5ba07ac), ARISE-Initiative/robomimic v0.2.0 and torchvision
importable, and this repository. There is no torchvision for a CPU build of torch: the files were made with a module
in its place that has ``models.resnet18`` with torchvision's names, and the transforms that robomimic imports::

    PYTHONPATH=path/to/diffusion_policy:path/to/robomimic:. python -m tests.policies.golden.make_hybrid
"""

from pathlib import Path
from typing import Any
from unittest.mock import patch

import diffusers.schedulers as schedulers
import numpy as np
import torch
from diffusion_policy.policy.diffusion_transformer_hybrid_image_policy import DiffusionTransformerHybridImagePolicy

from .. import hybrid


def main() -> None:
    """One file a variant."""
    for variant in hybrid.VARIANTS:
        path = Path(__file__).with_name(f"hybrid_{variant}.npz")
        np.savez_compressed(path, **run(variant))
        print(path, path.stat().st_size, "bytes")


@torch.no_grad()
def run(variant: str) -> dict[str, Any]:
    """The original's actions and the features of its encoder, with noise from outside."""
    settings = dict(hybrid.configuration(variant)["policy"])
    del settings["_target_"]
    scheduler = dict(settings.pop("noise_scheduler"))
    made = getattr(schedulers, scheduler.pop("_target_").rpartition(".")[2])(**scheduler)
    policy = DiffusionTransformerHybridImagePolicy(noise_scheduler=made, **settings)
    own = policy.state_dict()
    weights = hybrid.state_dict(variant)
    missing = sorted(set(own) - set(weights))
    assert all("_dummy_variable" in name for name in missing), missing
    assert all(name in own or name.startswith("normalizer.") for name in weights), sorted(set(weights) - set(own))
    # Nothing of the network is left as it was, masks, grids and the like aside, which must agree.
    for name, value in own.items():
        if name in weights and name.endswith(("mask", "pos_x", "pos_y", "temperature")):
            assert torch.equal(value, weights[name]), name
    policy.load_state_dict(weights, strict=False)
    policy.eval()
    initial, draws = hybrid.noise(variant)
    observation = {key: torch.from_numpy(value) for key, value in hybrid.observation(variant).items()}
    normalized = {key: value.flatten(0, 1) for key, value in policy.normalizer.normalize(observation).items()}
    features = policy.obs_encoder(normalized)
    order = iter(torch.from_numpy(draws))
    module = type(made).__module__
    with (
        patch("torch.randn", lambda *args, **kwargs: torch.from_numpy(initial)),
        patch(f"{module}.randn_tensor", lambda *args, **kwargs: next(order)),
    ):
        result = policy.predict_action(observation)
    return {
        "features": features.numpy(),
        "action": result["action"].numpy(),
        "action_pred": result["action_pred"].numpy(),
        "timesteps": made.timesteps.numpy(),
    }


if __name__ == "__main__":
    main()
