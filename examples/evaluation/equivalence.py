"""Is a plan as good as the original? Equivalent within a margin, worse, or not told by so few episodes.

An interval of a difference that contains 0 proves nothing: few episodes always give one. What proves that nothing is
lost is an interval whose lower end is above a margin that was named before (a test of non-inferiority; Piaggio et al.,
JAMA 2012).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

from bootstrap import Estimate, Values, paired_difference, paired_difference_of_shares

SCORE_MARGIN, SUCCESS_MARGIN = 0.03, 0.05
"""What may be lost, at most: of the score, which is 0 to 1, and of the share of episodes that succeed."""
EQUIVALENT, WORSE, TOO_FEW = "equivalent", "worse", "too few episodes"
FEWEST = 50
"""Episodes whose scores can prove equivalence. Resampling knows no loss that none of them had: what strikes 6 % of all
episodes is among 50 of them with 95 %. (The intervals of shares are wide enough for any number.)"""
POWER = 0.8
"""Share of the runs of ``Verdict.enough`` episodes that settle it."""
ERROR = 0.05
"""Of all comparisons of a table together: the chance that an interval misses (Bonferroni)."""


@dataclass(frozen=True)
class Verdict:
    """What some paired episodes say of a difference.

    Attributes:
        word: ``EQUIVALENT`` if the interval is above the margin, for scores of at least ``FEWEST`` episodes; ``WORSE``
            if it is not above, and below 0; else ``TOO_FEW``.
        difference: from the baseline, with its interval.
        margin: that may be lost, positive.
        episodes: that were paired.
        comparisons: that share the error.
        enough: episodes that would do in four of five cases, if the difference is what was found; None where it is
            settled.
    """

    word: str
    difference: Estimate
    margin: float
    episodes: int
    comparisons: int
    enough: int | None

    def __str__(self) -> str:
        low, high = (f"{value:+.3f}" for value in (self.difference.low, self.difference.high))
        said = f"{self.word}: {self.difference.mean:+.3f} [{low}, {high}]"
        return said if self.enough is None else f"{said}; {self.enough:,} would do"


def verdict(
    values: Values, baseline: Values, margin: float, *, shares: bool = False, comparisons: int = 1, seed: int = 0
) -> Verdict:
    """Hold values against a baseline of the same seeds.

    Args:
        values: one an episode.
        baseline: likewise, in the same order.
        margin: that may be lost, positive.
        shares: values are 0 or 1.
        comparisons: that are made at once, of which all intervals shall hold with 95 %.
        seed: of the resampling; see ``bootstrap.estimate``.

    Returns:
        The verdict.

    Raises:
        ValueError: the margin is not positive, or the episodes are not paired.
    """
    if not margin > 0:
        raise ValueError(f"expected a margin above 0; found {margin}. Say what may be lost.")
    level = 1 - ERROR / comparisons
    if shares:
        found = paired_difference_of_shares(values, baseline, level)
    else:
        found = paired_difference(values, baseline, seed, level)
    word = word_of(found.low, found.high, margin)
    made = Verdict(word, found, margin, len(values), comparisons, None)
    if word == EQUIVALENT and not shares and len(values) < FEWEST:
        return replace(made, word=TOO_FEW, enough=FEWEST)
    if word != TOO_FEW:
        return made
    enough = _enough(found, margin, len(values), level)
    return replace(made, enough=enough if shares else max(enough, FEWEST))


def word_of(low: float, high: float, margin: float) -> str:
    """What an interval of a difference says, where it is wide enough for so many episodes."""
    return EQUIVALENT if low > -margin else WORSE if high < 0 else TOO_FEW


def _enough(found: Estimate, margin: float, episodes: int, level: float) -> int:
    """How many episodes settle it with ``POWER``.

    The half-width of an interval falls with the root of the number of episodes. If it is just as wide as the room that
    there is, every other run settles it, because the mean varies as well.
    """
    if found.mean > -margin:
        width, room = found.mean - found.low, found.mean + margin  # to be called equivalent
    else:
        width, room = found.high - found.mean, -found.mean  # to be called worse
    z = NormalDist().inv_cdf((1 + level) / 2)
    wider = (z + NormalDist().inv_cdf(POWER)) / z
    return math.ceil(episodes * (wider * width / room) ** 2 / 10) * 10


def joined(verdicts: Sequence[Verdict]) -> str:
    """One word for several measures: worse if one is, equivalent if all are."""
    words = {each.word for each in verdicts}
    return next((word for word in (WORSE, TOO_FEW) if word in words), EQUIVALENT)
