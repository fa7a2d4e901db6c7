"""Run lerobot's SmolVLA on images of another size, and without one of its cameras: ``lerobot_smolvla.npz``.

Not run by the tests. Needs lerobot 0.6.1 with transformers, the shared golden files, and this repository::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_smolvla SHARED/golden/lerobot_whole
"""

import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, patch

import numpy as np
import torch
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

from ..vlas import CAMERAS, arrays, frame, processed


@torch.no_grad()
def main() -> None:
    """One file."""
    torch.set_num_threads(1)
    os.chdir(sys.argv[1])  # vlm_model_name is a folder here
    numbers = dict[str, Any]()
    with np.load("smolvla.npz") as golden:
        given = arrays(golden, 0)
    # Of its processor the policy asks the numbers of two tokens, which it does not use; the rest needs torchvision.
    tokenizer = SimpleNamespace(fake_image_token_id=0, global_image_token_id=0)
    with patch("lerobot.policies.smolvla.smolvlm_with_expert.AutoProcessor") as processors:
        processors.from_pretrained = Mock(return_value=SimpleNamespace(tokenizer=tokenizer))
        policy = SmolVLAPolicy.from_pretrained("smolvla").eval()
    for name, size, missing in (("large", (150, 110), None), ("missing", (96, 128), CAMERAS[1])):
        policy.config.empty_cameras = int(missing is not None)
        raw = {key: torch.from_numpy(value) for key, value in frame(given, size).items() if key != missing}
        batch, after = processed("smolvla", raw, str(given["task"]))
        chunk = policy.predict_action_chunk(batch, noise=torch.from_numpy(given["noise"]))
        numbers[name] = after(chunk).numpy()
    path = Path(__file__).with_name("lerobot_smolvla.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
