"""Run the original teacher and student on seeded weights, and write what they give: ``consistency_policy.npz``.

Not run by the tests. Needs Aaditya-Prasad/consistency-policy (eed0c46), ARISE-Initiative/robomimic v0.2.0, and
real-stanford/diffusion_policy (5ba07ac) importable, and this repository. The first has a copy of the last, the same in
all that is run here. torchvision and pytorch3d need not be there::

    PYTHONPATH=path/to/consistency-policy:path/to/diffusion_policy:path/to/robomimic:. \\
        python -m tests.policies.golden.make_consistency_policy
"""

import sys
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, patch

import numpy as np
import torch

from .. import consistency
from .make_unets import made
from .torchvision_stand_in import put_in_place


def main() -> None:
    """One file."""
    put_in_place()
    for name in ("pytorch3d", "pytorch3d.transforms"):  # imported, never called
        sys.modules[name] = MagicMock()
    path = Path(__file__).with_name("consistency_policy.npz")
    numbers = {f"{variant}.{key}": value for variant in consistency.VARIANTS for key, value in run(variant).items()}
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


@torch.no_grad()
def run(variant: str) -> dict[str, Any]:
    """The original's actions, and what its network was told and gave, with noise from outside."""
    settings = consistency.configuration(variant)["policy"]
    # As get_policy sets it: without it a student is made of its teacher's checkpoint.
    policy = made(settings | {"inference_mode": True})
    own, weights = policy.state_dict(), consistency.state_dict(variant)
    unknown = sorted(set(own) - set(weights))
    assert all(name.endswith(("_dummy_variable", "num_batches_tracked")) for name in unknown), unknown
    assert all(name.startswith("normalizer.") for name in set(weights) - set(own)), sorted(set(weights) - set(own))
    policy.load_state_dict(weights, strict=False)
    policy.eval()
    if consistency.VARIANTS[variant].get("chained"):
        policy.enable_chaining()
    evaluations: list[tuple[tuple[Any, ...], Any]] = []
    policy.model.register_forward_hook(lambda module, args, out: evaluations.append((args, out)))
    initial, draws = consistency.noise(8)
    order = iter(torch.from_numpy(np.concatenate([initial[None], draws])))
    observation = {key: torch.from_numpy(value) for key, value in consistency.observation().items()}
    with patch("torch.randn", lambda *args, **kwargs: next(order).clone()):
        result = policy.predict_action(observation)
    told = [float(torch.as_tensor(args[1]).flatten()[0]) for args, _ in evaluations]
    return {
        "action": result["action"].numpy(),
        "action_pred": result["action_pred"].numpy(),
        "told": np.array(told, np.float32),
        "first_out": evaluations[0][1].numpy(),
    }


if __name__ == "__main__":
    main()
