"""A page that says a compiled policy is as good as the original names a margin and a number of episodes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.claims import EQUIVALENT, PAGES, items
from tests.pages import ROOT

PROVES_NOTHING = re.compile(
    r"\b(?:keep(?:s|ing)?|kept) (?:(?:the|its|their|his|all|full|of|original's) )*(?:score|success)"
    r"|\blos(?:es?|t) (?:nothing|none of)|\bno loss\b|\bcost(?:s|ing)? no (?:score|success)"
    r"|\bsolves? as many episodes\b|\bas good as (?!the original\b)"
    r"|\b(?:can|cannot|could|could not) be told\b|\bnot told (?:apart )?from\b|\bnot told apart\b|\bno row tells\b"
)
"""What only an infinite number of episodes could show; and what few episodes always give, an interval with 0 in it."""
MARGIN = re.compile(r"\b\d+(?:\.\d+)? (?:points|of the score)|\bmargin")
EPISODES = re.compile(r"\b[\d,]+ (?:paired )?episodes\b")


def unproven(text: str) -> list[str]:
    """Items that claim more than can be measured, or equivalence without a margin and a number of episodes."""
    found = [one for one in items(text) if PROVES_NOTHING.search(one)]
    return found + [
        one
        for one in items(text)
        if EQUIVALENT.search(one) and "| equivalent |" not in one and not (MARGIN.search(one) and EPISODES.search(one))
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_claims_what_was_measured(page: Path) -> None:
    assert not unproven(page.read_text())


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("Two steps keep the score.", 1),
        ("- Two steps keep\n  the original's success, 20 %.", 1),
        ("So half of the loop loses nothing.", 1),
        ("Three steps keep the original's full success.", 1),
        ("It runs faster, keeping its success.", 1),
        ("Half of the steps cost no score.", 1),
        ("Two steps lose none of the dense policy's success.", 1),
        ("Two steps solve as many episodes.", 1),
        ("It is as good as the transformer above.", 1),
        ("With noise no difference in score can be told.", 1),
        ("Two steps cannot be told apart from the original.", 1),
        ("Five evaluations are not told from the original in success.", 1),
        ("Latency of up to 6 ticks costs nothing that can be told.", 1),
        ("Two steps lose at most 8.3 points, in 108 episodes.", 0),
        ("It is equivalent to the original.", 1),
        ("It is as good as the original.", 1),
        ("It is equivalent to the original, 0.93 in all episodes.", 1),
        ("It is equivalent within 5 points, in all episodes.", 1),
        ("It is equivalent in 800 episodes, where the original scores 0.94.", 1),
        ("It is as good as the original within a margin, in 2,400 paired episodes.", 0),
        ("It is equivalent: less than 0.03 of the score is lost, in 800 episodes.", 0),
        ("## As good as the original?", 0),
        ("It says whether it is as good as the original.", 0),
        ("Another is driven if the default is not equivalent.", 0),
        ("Three steps are equivalent: less than 5 points are lost, in 800 episodes.", 0),
        ("Three steps score 0.93 where the original scores 0.94.", 0),
    ],
)
def test_what_is_a_claim(text: str, count: int) -> None:
    assert len(unproven(text)) == count
