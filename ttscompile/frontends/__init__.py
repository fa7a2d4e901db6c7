"""Readers of the checkpoints that users have: each gives a module and a ``PolicySpec``; nothing after it differs."""

from __future__ import annotations

import os
from pathlib import Path

from torch import nn

from ..core.spec import PolicySpec
from ..errors import CheckpointError
from .diffusion_policy import load_diffusion_policy
from .lerobot import load_lerobot
from .lerobot_config import is_lerobot
from .refusals import refuse_directory

FORMATS = ("auto", "diffusion_policy", "lerobot")


def load_checkpoint_policy(
    path: str | os.PathLike[str],
    format: str = "auto",
    sampler: str | None = None,
    steps: int | None = None,
    spacing: str | None = None,
    task: str | None = None,
    encoders: str | os.PathLike[str] | None = None,
) -> tuple[nn.Module, PolicySpec]:
    """Load a trained policy without the code that trained it, and without running anything from the file.

    Args:
        path: the checkpoint.
        format: one of ``FORMATS``; ``auto`` tells by what is there.
        sampler: ``ddpm``, ``ddim`` or ``dpmsolver++`` on the same betas, in place of the checkpoint's own; of a
            flow-matching policy ``euler`` or ``rk4``.
        steps: number of denoising or integration steps, in place of the checkpoint's own.
        spacing: ``leading``, ``trailing`` or ``linspace`` timesteps, in place of the checkpoint's own.
        task: of a LeRobot policy: the one instruction that is compiled in, so that the robot needs no tokenizer; None
            makes its tokens an observation.
        encoders: of a LeRobot policy: folder with the configurations (and tokenizers) of its CLIP encoders, where they
            are neither in nor beside the checkpoint.

    Returns:
        The denoiser in eval mode, which takes the sample ``[B, T, D]``, the timestep ``[B]`` and the observations,
        normalised as the second result says, and everything else about the policy.

    Raises:
        CheckpointError: unreadable, unsafe, or not a supported policy.
        SpecError: the sampler asked for is not possible.
    """
    if format not in FORMATS:
        raise CheckpointError(f"format {format!r} is not known; expected one of {', '.join(FORMATS)}.")
    if format == "lerobot" or (format == "auto" and Path(path).is_dir()):
        _require_lerobot(Path(path))
        return load_lerobot(path, sampler=sampler, steps=steps, spacing=spacing, task=task, encoders=encoders)
    if task is not None or encoders is not None:
        raise CheckpointError(f"{path}: task and encoders are for LeRobot policies; this is one of Diffusion Policy.")
    if Path(path).is_dir():
        refuse_directory(Path(path))
    return load_diffusion_policy(path, sampler=sampler, steps=steps, spacing=spacing)


def _require_lerobot(path: Path) -> None:
    """Raise unless there is a policy that lerobot saved."""
    if not path.is_dir():
        raise CheckpointError(
            f"{path}: no such directory; expected one that lerobot's save_pretrained wrote, with config.json and"
            " model.safetensors."
        )
    if not is_lerobot(path):
        refuse_directory(path)
