"""Run lerobot's ``act`` on seeded weights, and write what it gives: ``lerobot_act_VARIANT.npz``.

Not run by the tests. Needs lerobot 0.6.1 and torchvision; this repository has to be importable::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_act
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from lerobot.policies.act.modeling_act import ACTPolicy
from safetensors.torch import load_file

from .. import acts
from ..vlas import pipelines


def main() -> None:
    """One file a variant."""
    torch.set_num_threads(1)
    for variant in acts.VARIANTS:
        with TemporaryDirectory() as folder:
            numbers = run(acts.save(variant, Path(folder) / "policy"), variant)
        path = Path(__file__).with_name(f"lerobot_act_{variant}.npz")
        np.savez_compressed(path, **numbers)
        print(path, path.stat().st_size, "bytes", {key: float(np.ptp(each)) for key, each in numbers.items()})


@torch.no_grad()
def run(directory: Path, variant: str) -> dict[str, Any]:
    """Actions of a policy: the whole chunk normalised, and what is executed in the robot's units."""
    policy = ACTPolicy.from_pretrained(directory).eval()
    own, saved = policy.state_dict(), load_file(directory / "model.safetensors")
    assert sorted(own) == sorted(saved), sorted(set(own) ^ set(saved))
    assert all(torch.equal(value, saved[name]) for name, value in own.items())
    before, after = pipelines(directory)
    given = {key: torch.from_numpy(value[:, 0]) for key, value in acts.observation(variant).items()}
    batch = {key: value for key, value in before(given).items() if key.startswith("observation.")}
    # lerobot asks this entry on which device to compute, of policies that do not read it, too.
    batch.setdefault("observation.state", torch.zeros(acts.STREAMS, 1))
    chunk = policy.predict_action_chunk(batch)
    taken = torch.stack([policy.select_action(batch) for _ in range(policy.config.n_action_steps)], dim=1)
    return {"action_normalized": chunk.numpy(), "action": after(taken).numpy()}


if __name__ == "__main__":
    main()
