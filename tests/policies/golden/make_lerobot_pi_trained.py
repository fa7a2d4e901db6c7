"""Run lerobot's pi05 that was trained to go on from a prefix, at tiny size: ``lerobot_pi_trained.npz``.

Not run by the tests. No release of lerobot has this yet: needs the sources of huggingface/lerobot at 7427f31, and what
lerobot 0.6.1 needs. This repository has to be importable::

    PYTHONPATH=.:path/to/lerobot/src python -m tests.policies.golden.make_lerobot_pi_trained
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from lerobot.policies.rtc.configuration_rtc import RTCConfig

from .. import pis
from ..lerobot_tiny import change_json
from .make_lerobot_pi import chunk, tiny


@torch.no_grad()
def main() -> None:
    """One file: chunks without a prefix and with all lengths of it, in robot units, and the prefix itself."""
    torch.set_num_threads(1)
    with TemporaryDirectory() as folder:
        directory = pis.save("pi05", Path(folder) / "policy")
        change_json(directory / "config.json", rtc_training_max_delay=pis.TRAINED)
        policy = tiny("pi05", directory)
        given, left_over = pis.observation(0), torch.from_numpy(pis.left_over())
        numbers: dict[str, Any] = {"without": chunk(policy, directory, given)}
        policy.config.rtc_config = RTCConfig(mode="trained")
        policy.init_rtc_processor()
        for delay in range(pis.TRAINED + 1):
            numbers[f"{delay}"] = chunk(policy, directory, given, left_over, delay)
    path = Path(__file__).with_name("lerobot_pi_trained.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
