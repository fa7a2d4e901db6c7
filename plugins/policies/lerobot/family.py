"""LeRobot: a directory that lerobot saved to module and ``PolicySpec``.

A type of policy is a module beside this one and a row in ``TYPES``. Everything in the directory is JSON and
safetensors; neither lerobot nor torchvision is needed.
"""

from importlib import import_module
from pathlib import Path

from torch import nn

from ttscompile.core.spec import PolicySpec
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.refusals import LEROBOT, refuse_policy
from ttscompile.frontends.settings import read_json

from .config import CONFIG
from .data_set import recordings
from .examined import examine
from .files import files_beside
from .tokenizer import tokenizer_file

__all__ = ["TYPES", "examine", "files_beside", "load", "recordings", "tokenizer_file"]

TYPES = {name: name for name in "act diffusion eo1 evo1 groot multi_task_dit smolvla vla_jepa wall_x xvla".split()}
TYPES |= {"pi0": "pi", "pi05": "pi"}
"""The module by ``type`` of ``config.json``, whose entries its ``load`` is given."""


def load(directory: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory; see ``Family.load``."""
    entries = read_json(directory / CONFIG)
    kind = str(entries.get("type"))
    if kind not in TYPES:
        refuse_policy(f"{kind:.80}", LEROBOT, f"{directory}: ")
    module = import_module(f".{TYPES[kind]}", __package__)
    return module.load(directory, entries, options)  # type: ignore[no-any-return]
