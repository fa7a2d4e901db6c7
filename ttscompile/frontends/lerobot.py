"""LeRobot: a directory that lerobot saved to module and ``PolicySpec``.

A type of policy is a module beside this one and a row in ``TYPES``. Everything in the directory is JSON and
safetensors; neither lerobot nor torchvision is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

from torch import nn

from ..core.spec import PolicySpec
from .families import LoadOptions
from .lerobot_config import CONFIG
from .refusals import LEROBOT, refuse_policy
from .settings import read_json

TYPES: Mapping[str, str] = {
    "act": "lerobot_act",
    "diffusion": "lerobot_diffusion",
    "evo1": "lerobot_evo1",
    "multi_task_dit": "lerobot_multi_task_dit",
    "pi0": "lerobot_pi",
    "pi05": "lerobot_pi",
    "smolvla": "lerobot_smolvla",
    "xvla": "lerobot_xvla",
}
"""By ``type`` of ``config.json``: the module, whose ``load`` is given its entries."""


def load(directory: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory; see ``Family.load``."""
    entries = read_json(directory / CONFIG)
    kind = str(entries.get("type"))
    if kind not in TYPES:
        refuse_policy(f"{kind:.80}", LEROBOT, f"{directory}: ")
    return import_module(f".{TYPES[kind]}", __package__).load(directory, entries, options)  # type: ignore[no-any-return]
