"""The strategies by name: this project's own, the paper's, and those of others."""

import pkgutil

from ..errors import CalibrationError
from .strategy import Strategy

STRATEGIES: tuple[Strategy, ...] = (
    Strategy(
        "tts",
        "whole steps with a correction, the same for every observation; this project's own",
        "calibration.tts:Tts",
        fits_correction=True,
    ),
    Strategy(
        "tts-paper",
        "test-time sparsity, arXiv 2605.13316, with a smaller head: gates trained for each observation",
        "calibration.pruner.paper:Paper",
        uses_pruner=True,
        consecutive=True,
    ),
    *pkgutil.resolve_name("ttscompile.rivals:RIVALS"),
)
"""In the order in which they are listed; the first one is the default."""

NAMES = tuple(one.name for one in STRATEGIES)

CORRECTING = tuple(one.name for one in STRATEGIES if one.fits_correction)
"""Names of those that fit a correction."""

DEFAULT = NAMES[0]


def strategy_of(name: str) -> Strategy:
    """The strategy of this name. Raises CalibrationError: there is none; lists those that there are."""
    for one in STRATEGIES:
        if one.name == name:
            return one
    raise CalibrationError(f"no strategy is called {name!r}; expected one of {', '.join(NAMES)}.")
