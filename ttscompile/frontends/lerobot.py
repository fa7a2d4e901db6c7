"""LeRobot: a directory that lerobot saved to module and ``PolicySpec``.

A type of policy is a module beside this one and a row in ``TYPES``. Everything in the directory is JSON and
safetensors; neither lerobot nor torchvision is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torch import nn

from ..core.spec import PolicySpec
from . import (
    lerobot_act,
    lerobot_diffusion,
    lerobot_evo1,
    lerobot_groot,
    lerobot_multi_task_dit,
    lerobot_pi,
    lerobot_smolvla,
)
from .families import LoadOptions
from .lerobot_config import CONFIG
from .refusals import LEROBOT, refuse_policy
from .settings import read_json

TYPES: Mapping[str, Callable[[Path, Mapping[str, Any], LoadOptions], tuple[nn.Module, PolicySpec]]] = {
    "act": lerobot_act.load,
    "diffusion": lerobot_diffusion.load,
    "evo1": lerobot_evo1.load,
    "groot": lerobot_groot.load,
    "multi_task_dit": lerobot_multi_task_dit.load,
    "pi0": lerobot_pi.load,
    "pi05": lerobot_pi.load,
    "smolvla": lerobot_smolvla.load,
}
"""By ``type`` of ``config.json``, whose entries they are given."""


def load(directory: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory; see ``Family.load``."""
    entries = read_json(directory / CONFIG)
    kind = str(entries.get("type"))
    if kind not in TYPES:
        refuse_policy(f"{kind:.80}", LEROBOT, f"{directory}: ")
    return TYPES[kind](directory, entries, options)
