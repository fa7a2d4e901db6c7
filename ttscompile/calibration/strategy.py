"""What is known about a strategy before it runs: what the command line and the pipeline read, without torch."""

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
        """The function that ``maker`` names. Raises ImportError or AttributeError: there is none."""
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
