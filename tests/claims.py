"""What the pages claim of plans: the pages, their items, and what calls a plan equivalent."""

from __future__ import annotations

import re

from tests.pages import ROOT

PAGES = [ROOT / "README.md", *(p for p in sorted((ROOT / "docs").rglob("*.md")) if p.name != "decisions.md")]
EQUIVALENT = re.compile(r"(?<!not )\bequivalent\b|(?<!whether it is )\bas good as the original\b(?!\?)")
"""A question claims nothing, nor does who denies it."""


def items(text: str) -> list[str]:
    """Paragraphs, points of lists and rows of tables, each on one line; what a program printed is none."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    return [" ".join(one.split()) for one in re.split(r"\n\s*\n|\n(?=- |\| )", text)]
