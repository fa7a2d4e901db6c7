"""Run lerobot's groot with actions relative to poses, at tiny sizes: ``lerobot_groot_eef.npz``, and its folder.

Not run by the tests. Needs lerobot 0.6.1 with transformers, diffusers and dm-tree; this repository has to be
importable::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_groot_eef
"""

import json
import os
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from lerobot.policies.groot.utils import relative_eef_to_absolute

from .. import eefs, groots
from ..vlas import Array
from . import make_lerobot_groot

TAGS = {"arm": "oxe_droid_relative_eef_relative_joint", "alone": "real_r1_pro_sharpa_relative_eef"}


@torch.no_grad()
def main() -> None:
    """Both, and the composition alone."""
    torch.set_num_threads(1)
    numbers: dict[str, Any] = composition()
    shutil.rmtree(eefs.SAVED, ignore_errors=True)
    for kind in eefs.KINDS:
        folder = eefs.SAVED / kind
        folder.mkdir(parents=True)
        os.chdir(folder)
        numbers |= chunks(kind)
        (folder / "policy" / "model.safetensors").unlink()
        (folder / groots.BASE / "model.safetensors").unlink()
        shutil.rmtree("nvidia")  # the backbone, which is that of ``groots``
    path = Path(__file__).with_name("lerobot_groot_eef.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def composition() -> dict[str, Array]:
    """Of random numbers, of which some are rotations: measured ``[N, 9]``, relative and absolute ``[N, T, 9]``."""
    rng = np.random.RandomState(0)
    measured, relative = (rng.uniform(-1, 1, shape).astype(np.float32) for shape in ((8, 9), (8, 5, 9)))
    measured[0, 3:], relative[0, 0, 3:] = [1, 0, 0, 0, 1, 0], [1, 0, 0, 0, 1, 0]
    measured[1, 3:], relative[:, 1, 3:] = [-1, 1e-4, 0, 1e-4, -1, 0], [-1, 0, 1e-4, 0, 1, 0]
    measured[2, 3:], relative[:, 2, 3:] = [1, 1e-5, 0, 0, 1, 1e-5], [1, 0, 1e-5, 0, 1, 0]
    found = {"measured": measured, "relative": relative, "absolute": relative_eef_to_absolute(relative, measured)}
    return {f"composition.{name}": value for name, value in found.items()}


def chunks(kind: str) -> dict[str, Array]:
    """Two calls, and one of two streams."""
    given = [*(eefs.observation(kind, call) for call in (0, 1)), eefs.both(kind)]  # images are drawn after a state
    own = make_lerobot_groot.PROCESSORS["native"] | {"modality_configs": {TAGS[kind]: eefs.modality(kind)}}
    sizes: dict[str, Any] = {"STATE_DIM": eefs.width(kind), "ACTION_DIM": eefs.width(kind)}
    sizes |= {"STATE_PADDED": eefs.STATE_PADDED, "PADDED": eefs.PADDED}
    tables: dict[str, Any] = {
        name: {kind: getattr(make_lerobot_groot, name)["native"]} for name in ("BACKBONES", "BASES")
    }
    tables["PROCESSORS"] = {kind: own | {"use_relative_action": True}}
    tables["POLICIES"] = {kind: {"embodiment_tag": TAGS[kind], "n_action_steps": eefs.STEPS}}
    with patch.multiple(groots, **sizes), patch.multiple(make_lerobot_groot, **tables):
        make_lerobot_groot.backbone(kind)
        make_lerobot_groot.base(kind)
        base = Path(groots.BASE)
        (base / "statistics.json").write_text(json.dumps({TAGS[kind]: eefs.statistics(kind)}, indent=1))
        (base / "embodiment_id.json").write_text(json.dumps({TAGS[kind]: 2, "leg": 0}))
        policy = make_lerobot_groot.save(kind)
        made = make_lerobot_groot.chunk
        found = {f"{kind}.{call}": made(policy, call, given[call], eefs.noise()) for call in (0, 1)}
        return found | {f"{kind}.both": made(policy, 0, given[2], eefs.noise(2))}


if __name__ == "__main__":
    main()
