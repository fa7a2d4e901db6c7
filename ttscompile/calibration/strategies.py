"""The strategies: one record each, of what is known about a strategy before it runs.

The command line and the pipeline read names, reach and properties here; so this module imports neither torch nor the
modules of the strategies. A strategy is its module and its row in ``STRATEGIES``: see ``docs/extending``.

TaylorSeer (arXiv 2503.06923) is not here. It adds ``r(o) + (k - o) * (r(o) - r(p)) / (o - p)``, a combination of two
computed residuals with a weight that grows with the step. A cell of the lattice adds one computed residual; neither a
plan, nor an artifact, nor the runtimes' sums of reused residuals could say or hold more without a fifth source.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..errors import CalibrationError

if TYPE_CHECKING:
    from .task import Search, Task


@dataclass(frozen=True)
class Strategy:
    """A way to find a plan.

    Attributes:
        name: what users call it.
        source: where the method is from.
        maker: where the function is that makes a ``Search`` of a ``Task``, as ``module:function`` below ``ttscompile``.
        least: how many cells its plans compute at least, of ``(steps, blocks)``; by default those of step 0.
        fits_correction: whether its schedule is of whole steps, with a correction of the sampler that is fitted to it.
            Only then are there plans for an error budget, and plans beside the target.
        uses_pruner: whether the pruner may depart from its schedule.
        consecutive: whether it learns from, and is judged on, consecutive calls of episodes, so that its plans may read
            what an earlier call computed.
        baseline: whether it is the uniform schedule, which every other strategy has to beat.
    """

    name: str
    source: str
    maker: str
    least: Callable[[int, int], int] = lambda steps, blocks: blocks
    fits_correction: bool = False
    uses_pruner: bool = False
    consecutive: bool = False
    baseline: bool = False

    def make(self) -> Callable[[Task], Search]:
        """The function that ``maker`` names.

        Raises:
            ImportError: there is no such module, or it needs a package that is not installed.
            AttributeError: the module has no such function.
        """
        found: Callable[[Task], Search] = pkgutil.resolve_name(f"ttscompile.{self.maker}")
        return found

    def require_reach(self, steps: int, blocks: int, budget: int) -> None:
        """Refuse a budget of computed cells, step 0 included, that the strategy cannot keep.

        Raises:
            CalibrationError: it computes more; says how much sparsity it can reach.
        """
        least, cells = self.least(steps, blocks), steps * blocks
        if budget < least:
            raise CalibrationError(
                f"strategy {self.name!r} computes at least {least} of the {steps} x {blocks} cells, a sparsity of"
                f" {1 - least / cells:.4g}; the target of {1 - budget / cells:.4g} leaves {budget}. Lower the target,"
                " or take another strategy."
            )


STRATEGIES = (
    Strategy(
        "tts",
        "whole steps with a correction, the same for every observation; this project's own",
        "calibration.tts:Tts",
        fits_correction=True,
    ),
    Strategy(
        "tts-paper",
        "test-time sparsity as published, arXiv 2605.13316: gates trained for each observation",
        "calibration.pruner.paper:Paper",
        uses_pruner=True,
        consecutive=True,
    ),
    Strategy(
        "interval",
        "FORA, arXiv 2407.01425; EfficientVLA (arXiv 2506.10100)",
        "rivals.static:interval",
        baseline=True,
    ),
    Strategy("bac", "block-wise adaptive caching (arXiv 2506.13456)", "rivals.bac:bac"),
    Strategy(
        "delta-dit",
        "Delta-DiT (arXiv 2406.01125)",
        "rivals.static:delta_dit",
        least=lambda steps, blocks: blocks + steps - 1,  # one block of every step after step 0
    ),
    Strategy(
        "deepcache",
        "DeepCache (arXiv 2312.00858)",
        "rivals.static:deepcache",
        least=lambda steps, blocks: blocks + (steps - 1) * min(2, blocks),  # the first and the last block of every step
    ),
    Strategy("sag", "Sparse ActionGen (arXiv 2601.12894)", "rivals.gates:sag"),
    Strategy("dip-go", "DiP-GO (arXiv 2410.16942)", "rivals.gates:dip_go"),
    Strategy(
        "l2c",
        "Learning-to-Cache (arXiv 2406.01733)",
        "rivals.gates:l2c",
        least=lambda steps, blocks: blocks * -(-steps // 2),  # every other step
    ),
    Strategy("evo", "genetic search (arXiv 2607.20293)", "rivals.evo:Evo"),
    Strategy(
        "teacache",
        "TeaCache (arXiv 2411.19108)",
        "rivals.online:teacache",
        least=lambda steps, blocks: blocks * min(2, steps),  # the first step and the last
    ),
    Strategy(
        "dbcache",
        "DBCache of cache-dit",
        "rivals.online:dbcache",
        least=lambda steps, blocks: blocks + steps - 1,  # the first block of every step after step 0
    ),
)
"""In the order in which they are listed; the first one is the default."""

NAMES = tuple(one.name for one in STRATEGIES)

FITTED = tuple(one.name for one in STRATEGIES if one.fits_correction)
"""Names of those that fit a correction."""

DEFAULT = NAMES[0]


def strategy_of(name: str) -> Strategy:
    """The strategy of this name. Raises CalibrationError: there is none; lists those that there are."""
    for one in STRATEGIES:
        if one.name == name:
            return one
    raise CalibrationError(f"no strategy is called {name!r}; expected one of {', '.join(NAMES)}.")
