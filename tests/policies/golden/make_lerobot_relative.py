"""Run lerobot's policies of relative actions at tiny sizes on seeded weights: ``lerobot_relative.npz``.

Not run by the tests. Needs the sources of huggingface/lerobot at 7427f31, and what lerobot 0.6.1 needs with its extra
vla-jepa. This repository has to be importable::

    PYTHONPATH=.:path/to/lerobot/src python -m tests.policies.golden.make_lerobot_relative
"""

import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.relative import reanchor_relative_rtc_prefix
from lerobot.processor import NormalizerProcessorStep, RelativeActionsProcessorStep

from .. import groots, pis, relatives, vla_jepas
from ..vlas import MASK, STATE, TOKENS, Array
from . import make_lerobot_groot, make_lerobot_vla_jepa
from .make_lerobot_pi import tiny


@torch.no_grad()
def main() -> None:
    """One file: chunks in robot units."""
    torch.set_num_threads(1)
    numbers: dict[str, Any] = {}
    for make in (pi0, pi05, groot, vla_jepa):
        with TemporaryDirectory() as folder:
            os.chdir(folder)
            numbers |= make()
    path = Path(__file__).with_name("lerobot_relative.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def pi0() -> dict[str, Array]:
    """Two states."""
    directory = relatives.save("pi0", Path.cwd())
    policy = tiny("pi0", directory)
    return {f"pi0.{call}": of_pi(policy, directory, "pi0", call) for call in (0, 1)}


def pi05() -> dict[str, Array]:
    """Two states; and of the first with prefixes of all lengths."""
    directory = relatives.save("pi05", Path.cwd())
    policy = tiny("pi05", directory)
    found = {f"pi05.{call}": of_pi(policy, directory, "pi05", call) for call in (0, 1)}
    policy.config.rtc_config = RTCConfig(mode="trained")
    policy.init_rtc_processor()
    delays = range(1, pis.TRAINED + 1)
    return found | {f"pi05.prefix.{delay}": of_pi(policy, directory, "pi05", 0, delay) for delay in delays}


def of_pi(policy: Any, directory: Path, kind: str, call: int, delay: int = 0) -> Array:
    """The actions of a whole chunk; tokens are given, so that no tokenizer is needed.

    So many of the committed actions are executed meanwhile. They come back to the network as lerobot's rollout sends
    them there.
    """
    given = {key: torch.from_numpy(value) for key, value in relatives.observation(kind, call).items()}
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(directory))
    batch = before({**{key: value for key, value in given.items() if key not in (TOKENS, MASK)}, "task": "go"})
    batch = {key: value for key, value in batch.items() if key.startswith("observation.")}
    batch = {key: value if value.ndim > given[key].ndim else value[None] for key, value in batch.items()}
    batch |= {key: given[key][None] for key in (TOKENS, MASK)}
    rest = {}
    if delay:
        (step,) = (each for each in before.steps if isinstance(each, RelativeActionsProcessorStep))
        (norm,) = (each for each in before.steps if isinstance(each, NormalizerProcessorStep))
        left = torch.from_numpy(relatives.committed()[0])
        left = reanchor_relative_rtc_prefix(left, given[STATE], step, norm, "cpu")
        rest = {"prev_chunk_left_over": left[None], "inference_delay": delay}
    return np.asarray(after(policy.predict_action_chunk(batch, noise=torch.from_numpy(pis.noise()), **rest)).numpy())


def groot() -> dict[str, Array]:
    """Two states; groups of which one has statistics for each step."""
    for make in (make_lerobot_groot.backbone, make_lerobot_groot.base):
        make("native")
    policy = make_lerobot_groot.save("native")
    relatives.with_relative_groups(Path("policy"))
    return {f"groot.{call}": make_lerobot_groot.chunk(policy, call, groots.observation(call)) for call in (0, 1)}


def vla_jepa() -> dict[str, Array]:
    """Two states; the gripper is absolute, and has two values."""
    own = {"use_relative_actions": True, "action_feature_names": list(relatives.WIDE)}
    own |= {"relative_exclude_joints": relatives.EXCLUDED}
    own |= dict.fromkeys(("binarize_gripper_action", "pre_snap_gripper_action", "clip_normalized_actions"), True)
    policies = {"libero": make_lerobot_vla_jepa.POLICIES["libero"] | own}
    make_lerobot_vla_jepa.backbone("libero")
    make_lerobot_vla_jepa.video()
    with (
        patch.object(make_lerobot_vla_jepa, "POLICIES", policies),
        patch.object(vla_jepas, "STATE_DIM", relatives.STATE_DIMS["vla_jepa"]),
    ):
        policy = make_lerobot_vla_jepa.save("libero")
    given = [relatives.observation("vla_jepa", call) for call in (0, 1)]
    return {f"vla_jepa.{call}": make_lerobot_vla_jepa.chunk(policy, call, given[call]) for call in (0, 1)}


if __name__ == "__main__":
    main()
