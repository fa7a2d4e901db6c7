"""For the site: the package as it is installed, and links to files that are no pages.

mkdocstrings reads source files where they lie; in this tree parts of the package lie beside it. See pyproject.toml.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FILES = "https://github.com/ttscompile/ttscompile/blob/main/"
TARGET = ROOT / "build" / "docs" / "ttscompile"


def on_startup(command: str, dirty: bool) -> None:
    """Lay the package out, before mkdocstrings looks for folders."""
    shutil.rmtree(TARGET, ignore_errors=True)
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "ttscompile", TARGET, ignore=ignored)
    for part in ("passes", "runtimes", "plugins/policies", "plugins/rivals", "plugins/serving"):
        shutil.copytree(ROOT / part, TARGET / Path(part).name, ignore=ignored)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links that leave ``docs/`` lead to the repository: the site has no such page."""
    folder = (ROOT / "docs" / page.file.src_uri).parent

    def outside(link: re.Match[str]) -> str:
        path, _, section = link[1].partition("#")
        there = (folder / path).resolve()
        if not path or there.is_relative_to(ROOT / "docs") or not there.is_relative_to(ROOT):
            return link[0]
        return f"]({FILES}{there.relative_to(ROOT).as_posix()}{'#' * bool(section)}{section})"

    return re.sub(r"\]\(([^)\s:]+)\)", outside, markdown)
