"""For the site's reference: the package as it is installed, with passes/, runtimes/ and parts of plugins/ inside it.

mkdocstrings reads source files where they lie; in this tree two parts of the package lie beside it. See pyproject.toml.
"""

from __future__ import annotations

import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "build" / "docs" / "ttscompile"


def on_startup(command: str, dirty: bool) -> None:
    """Lay the package out, before mkdocstrings looks for folders."""
    shutil.rmtree(TARGET, ignore_errors=True)
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "ttscompile", TARGET, ignore=ignored)
    for part in ("passes", "runtimes", "plugins/policies", "plugins/rivals", "plugins/serving"):
        shutil.copytree(ROOT / part, TARGET / Path(part).name, ignore=ignored)
