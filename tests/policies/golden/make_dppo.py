"""Run DPPO's evaluation on seeded weights, and write what it gives: ``dppo_VARIANT.npz``.

Not run by the tests. Needs irom-princeton/dppo (cc7234a), einops and omegaconf importable, and this repository::

    PYTHONPATH=path/to/dppo:. python -m tests.policies.golden.make_dppo
"""

from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from omegaconf import OmegaConf

from tests.families.golden.originals import absent, package

from .. import dppos


def main() -> None:
    """One file a variant."""
    OmegaConf.register_new_resolver("eval", eval)
    torch.set_num_threads(1)
    absent("gym", "gym.spaces", "imageio")  # of the wrapper its arithmetic alone is run
    root = Path(str(import_module("model").__file__)).parents[1] / "env" / "gym_utils"
    for name, folder in (("env", root.parent), ("env.gym_utils", root), ("env.gym_utils.wrapper", root / "wrapper")):
        package(name, folder)
    for variant in dppos.VARIANTS:
        path = Path(__file__).with_name(f"dppo_{variant}.npz")
        np.savez_compressed(path, **run(variant))
        print(path, path.stat().st_size, "bytes")


@torch.no_grad()
def run(variant: str) -> dict[str, Any]:
    """The actions of its evaluation, with noise from outside; normalised by what its wrapper of robomimic does."""
    settings = dppos.configuration(variant) | {"logdir": "", "base_policy_path": "", "device": "cpu"}
    resolved: Any = OmegaConf.to_container(OmegaConf.create(settings), resolve=True)
    model = resolved["model"]
    name = model.pop("_target_").rpartition(".")[2]
    network = model.pop("actor" if "actor" in model else "network")
    module, _, kind = network.pop("_target_").rpartition(".")
    made = getattr(import_module(module), kind)(**network)
    model |= {"ft_denoising_steps": model.get("ft_denoising_steps", 0)}
    with TemporaryDirectory() as folder:
        file = Path(folder) / "state_3.pt"
        torch.save(dppos.payload(variant), file)
        model |= {"network_path": str(file)}
        policy = import_module("model.diffusion.diffusion_eval").DiffusionEval(network=made, **model).eval()
    wrapper = object.__new__(import_module("env.gym_utils.wrapper.robomimic_lowdim").RobomimicLowdimWrapper)
    wrapper.__dict__ |= dppos.normalization() | {"clamp_obs": False}
    seen = torch.from_numpy(wrapper.normalize_obs(dppos.observation()["state"])).float()
    steps = model["ddim_steps"] if model.get("use_ddim") else model["denoising_steps"]
    initial, draws = dppos.noise(steps)
    order = iter(torch.from_numpy(draws))
    with (
        patch("torch.randn", lambda *args, **kwargs: torch.from_numpy(initial).clone()),
        patch("torch.randn_like", lambda *args, **kwargs: next(order).clone()),
    ):
        sample = policy({"state": seen}, deterministic=True).trajectories.numpy()
    actions = wrapper.unnormalize_action(sample)
    return {"policy": np.array(name), "action_pred": actions, "action": actions[:, :3], "steps": np.array(steps)}


if __name__ == "__main__":
    main()
