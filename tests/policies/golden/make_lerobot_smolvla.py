"""Run lerobot's SmolVLA on other images, with tokens around them, and smaller: ``lerobot_smolvla.npz``.

Not run by the tests. Needs lerobot 0.6.1 with transformers, the shared golden files, and this repository::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_smolvla SHARED/golden/lerobot_whole
"""

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, patch

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

from ..vlas import CAMERAS, Array, arrays, frame, processed, with_fewer_layers

SIZE = (96, 128)


@torch.no_grad()
def main() -> None:
    """One file."""
    torch.set_num_threads(1)
    os.chdir(sys.argv[1])  # vlm_model_name is a folder here
    numbers = dict[str, Any]()
    with np.load("smolvla.npz") as golden:
        given = arrays(golden, 0)
    # Of its processor the policy asks the numbers of two tokens; the rest needs torchvision.
    added = json.loads(Path("smolvlm-tiny", "tokenizer.json").read_text())["added_tokens"]
    ids = {token["content"]: token["id"] for token in added}
    image, whole = ids["<fake_token_around_image>"], ids["<global-img>"]
    tokenizer = SimpleNamespace(fake_image_token_id=image, global_image_token_id=whole)
    with patch("lerobot.policies.smolvla.smolvlm_with_expert.AutoProcessor") as processors:
        processors.from_pretrained = Mock(return_value=SimpleNamespace(tokenizer=tokenizer))
        policy = SmolVLAPolicy.from_pretrained("smolvla").eval()
        config = PreTrainedConfig.from_pretrained("smolvla")
        config.num_expert_layers, config.self_attn_every_n_layers = 2, -1
        fewer = SmolVLAPolicy(config).eval()
    fewer.load_state_dict(with_fewer_layers(policy.state_dict()))
    numbers["large"] = chunk(policy, given, (150, 110))
    numbers["missing"] = chunk(policy, given, SIZE, CAMERAS[1])
    numbers["fewer"] = chunk(fewer, given, SIZE)
    policy.model.add_image_special_tokens = True
    numbers["around"] = chunk(policy, given, SIZE)
    numbers["around.missing"] = chunk(policy, given, SIZE, CAMERAS[1])
    path = Path(__file__).with_name("lerobot_smolvla.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def chunk(policy: Any, given: Mapping[str, Array], size: tuple[int, int], missing: str = "") -> Array:
    """The actions of a whole chunk in robot units."""
    policy.config.empty_cameras = int(missing != "")
    raw = {key: torch.from_numpy(value) for key, value in frame(given, size).items() if key != missing}
    batch, after = processed("smolvla", raw, str(given["task"]))
    made: Array = after(policy.predict_action_chunk(batch, noise=torch.from_numpy(given["noise"]))).numpy()
    return made


if __name__ == "__main__":
    main()
