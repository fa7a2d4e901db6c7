"""Golden checkpoints of Diffusion Policy, compiled once a run."""

from __future__ import annotations

from pathlib import Path

import ttscompile
from ttscompile.ir.program import Program

from .once import Once


def compiled_golden(once: Once, shared: Path, name: str) -> tuple[Path, Program]:
    """Artifact and program of ``golden/diffusion_policy/<name>.ckpt``, or of ``policies/pusht_dpt.ckpt``."""
    folder = "policies" if name == "pusht_dpt" else "golden/diffusion_policy"
    checkpoint = shared / folder / f"{name}.ckpt"
    return once.compiled(f"golden {name}", lambda directory: ttscompile.convert(checkpoint, directory))
