"""Readers of the checkpoints that users have: each gives a module and a ``PolicySpec``; nothing after it differs."""

from __future__ import annotations

import os
from pathlib import Path

from torch import nn

from ..config import PolicySpec
from ..errors import CheckpointError
from .diffusion_policy import load_diffusion_policy

FORMATS = ("auto", "diffusion_policy")


def load_checkpoint_policy(
    path: str | os.PathLike[str],
    format: str = "auto",
    sampler: str | None = None,
    steps: int | None = None,
    spacing: str | None = None,
) -> tuple[nn.Module, PolicySpec]:
    """Load a trained policy without the code that trained it, and without running anything from the file.

    Args:
        path: the checkpoint.
        format: one of ``FORMATS``; ``auto`` tells by what is there.
        sampler: ``ddpm`` or ``ddim`` on the same betas, in place of the checkpoint's own.
        steps: number of denoising steps, in place of the checkpoint's own.
        spacing: ``leading``, ``trailing`` or ``linspace`` timesteps, in place of the checkpoint's own.

    Returns:
        The denoiser in eval mode, ``forward(sample [B, T, D], timestep int64 [B], obs [B, To, Do] normalised)``, and
        everything else about the policy.

    Raises:
        CheckpointError: unreadable, unsafe, or not a supported policy.
        SpecError: the sampler asked for is not possible.
    """
    if format not in FORMATS:
        raise CheckpointError(f"format {format!r} is not known; expected one of {', '.join(FORMATS)}.")
    if Path(path).is_dir():
        raise CheckpointError(
            f"{path} is a directory; expected a .ckpt file of Diffusion Policy. Policies saved as directories (LeRobot)"
            " are not supported; build the denoiser yourself and use ttscompile.compile_denoiser(module, spec)."
        )
    return load_diffusion_policy(path, sampler=sampler, steps=steps, spacing=spacing)
