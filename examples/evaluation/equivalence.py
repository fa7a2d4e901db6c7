"""Is a plan as good as the original? Equivalent within a margin, worse, or not told by so few episodes.

An interval of a difference that contains 0 proves nothing: few episodes always give one. What proves that nothing is
lost is an interval whose lower end is above a margin that was named before (a test of non-inferiority; Piaggio et al.,
JAMA 2012).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from bootstrap import Estimate, Values, paired_difference, paired_difference_of_shares

SCORE_MARGIN, SUCCESS_MARGIN = 0.03, 0.05
"""What may be lost, at most: of the score, which is 0 to 1, and of the share of episodes that succeed."""
EQUIVALENT, WORSE, TOO_FEW = "equivalent", "worse", "too few episodes"
ERROR = 0.05
"""Of all comparisons of a table together: the chance that an interval misses (Bonferroni)."""


@dataclass(frozen=True)
class Verdict:
    """What some paired episodes say of a difference.

    Attributes:
        word: ``EQUIVALENT`` if the interval is above the margin; ``WORSE`` if it is not, and below 0; else ``TOO_FEW``.
        difference: from the baseline, with its interval.
        margin: that may be lost, positive.
        episodes: that were paired.
        comparisons: that share the error.
        enough: episodes that would probably settle it, if the difference stays as it is; None where it is settled, and
            where it lies on the margin.
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
    word = EQUIVALENT if found.low > -margin else WORSE if found.high < 0 else TOO_FEW
    enough = None if word != TOO_FEW else _enough(found, margin, len(values))
    return Verdict(word, found, margin, len(values), comparisons, enough)


def _enough(found: Estimate, margin: float, episodes: int) -> int | None:
    """The half-width of an interval falls with the root of the number of episodes."""
    if found.mean > -margin:
        width, room = found.mean - found.low, found.mean + margin  # to be called equivalent
    else:
        width, room = found.high - found.mean, -found.mean  # to be called worse
    return math.ceil(episodes * (width / room) ** 2 / 10) * 10 if room > 0 else None


def joined(verdicts: Sequence[Verdict]) -> str:
    """One word for several measures: worse if one is, equivalent if all are."""
    words = {each.word for each in verdicts}
    return next((word for word in (WORSE, TOO_FEW) if word in words), EQUIVALENT)
