"""The source of the package, for whoever installs it somewhere else."""

from __future__ import annotations

import shutil
from pathlib import Path

from .imports import PACKAGES

ROOT = Path(__file__).resolve().parents[1]


def source_copy(target: Path) -> Path:
    """What a wheel is built from, without what git ignores: building one leaves its build folder beside the source."""
    target.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, target)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, target / name, ignore=shutil.ignore_patterns("__pycache__"))
    return target
