"""Ways to find a plan: one file each, behind the interface in ``base``.

=============  ===============================================================================================
name           what it is
=============  ===============================================================================================
``tts``        test-time sparsity (arXiv 2605.13316): learned, and moved by the observation
``interval``   whole steps at even distances: FORA (arXiv 2407.01425), EfficientVLA (arXiv 2506.10100)
``bac``        block-wise adaptive caching (arXiv 2506.13456): dynamic programme, then bubbling union
``delta-dit``  Delta-DiT (arXiv 2406.01125): rear blocks reused early, front blocks late
``deepcache``  DeepCache (arXiv 2312.00858): the outermost blocks fresh at every step
``sag``        Sparse ActionGen (arXiv 2601.12894): learned gates over FORWARD alone, frozen
``dip-go``     DiP-GO (arXiv 2410.16942): learned gates over TIMESTEP, frozen
``l2c``        Learning-to-Cache (arXiv 2406.01733): the same at every other step
``evo``        genetic search (arXiv 2607.20293)
``teacache``   TeaCache (arXiv 2411.19108): online, by the change of the first block's input
``dbcache``    DBCache of cache-dit: online, by what the first blocks add
=============  ===============================================================================================

TaylorSeer (arXiv 2503.06923) is not here. It adds ``r(o) + (k - o) * (r(o) - r(p)) / (o - p)``, a combination of two
computed residuals with a weight that grows with the step. A cell of the lattice adds one computed residual; neither a
plan, nor an artifact, nor the runtimes' sums of reused residuals could say or hold more without a fifth source.
"""

from __future__ import annotations

import math
from dataclasses import replace

from ...core.lattice import Source
from ...errors import CalibrationError
from ..clock import Clock
from ..search import search_plan
from ..whole_steps import WholeSteps
from . import dbcache, deepcache, delta_dit, gates, teacache
from .bac import bac
from .base import Found, Strategy, Task
from .evo import Evo
from .fixed import Fixed
from .gates import Gates
from .interval import interval
from .tts import Tts

NAMES = (
    "tts",
    "interval",
    "bac",
    "delta-dit",
    "deepcache",
    "sag",
    "dip-go",
    "l2c",
    "evo",
    "teacache",
    "dbcache",
)

_LEAST = {
    "delta-dit": delta_dit.least_cells,
    "deepcache": deepcache.least_cells,
    "l2c": gates.least_cells_l2c,
    "teacache": teacache.least_cells,
    "dbcache": dbcache.least_cells,
}
"""Cells that a strategy computes at least, of ``steps`` and ``blocks``; step 0 for those that are not here."""

__all__ = ["NAMES", "Found", "Strategy", "Task", "open_strategy", "plan_of", "require_reach", "require_strategy"]


def require_strategy(name: str) -> None:
    """Refuse a name that no strategy has.

    Raises:
        CalibrationError: lists those that there are.
    """
    if name not in NAMES:
        raise CalibrationError(f"no strategy is called {name!r}; expected one of {', '.join(NAMES)}.")


def require_reach(name: str, steps: int, blocks: int, budget: int) -> None:
    """Refuse a budget that a strategy cannot keep.

    Args:
        name: of the strategy.
        steps: K.
        blocks: number of residual blocks.
        budget: cells that may be computed, step 0 included.

    Raises:
        CalibrationError: there is no such strategy, or it computes more; says how much sparsity it can reach.
    """
    require_strategy(name)
    least = _LEAST[name](steps, blocks) if name in _LEAST else blocks
    if budget < least:
        cells = steps * blocks
        raise CalibrationError(
            f"strategy {name!r} computes at least {least} of the {steps} x {blocks} cells, a sparsity of"
            f" {1 - least / cells:.4g}; the target of {1 - budget / cells:.4g} leaves {budget}. Lower the target, or"
            " take another strategy."
        )


def open_strategy(name: str, task: Task, whole: WholeSteps | None = None) -> Strategy:
    """The strategy of this name, ready to begin.

    Args:
        name: of the strategy.
        task: see ``Task``.
        whole: of the same calls, for ``tts``; None makes one.

    Raises:
        CalibrationError: there is none, or it cannot keep the budget.
    """
    model = task.executor.model
    require_reach(name, model.steps, model.blocks, task.budget)
    match name:
        case "tts":
            return Tts(task, whole or WholeSteps(task))
        case "interval":
            return Fixed(task, interval)
        case "bac":
            return Fixed(task, bac)
        case "delta-dit":
            return Fixed(task, delta_dit.delta_dit)
        case "deepcache":
            return Fixed(task, deepcache.deepcache)
        case "sag":
            return Gates(task, Source.FORWARD)
        case "dip-go":
            return Gates(task, Source.TIMESTEP)
        case "l2c":
            return Gates(task, Source.TIMESTEP, whole=2)
        case "evo":
            return Evo(task)
        case "teacache":
            return Fixed(task, teacache.teacache)
        case _:
            return Fixed(task, dbcache.dbcache)


def plan_of(name: str, task: Task, intervals: int | None = None, seconds: float = math.inf) -> tuple[Found, bool]:
    """What a strategy finds, whether or not it is any better than the uniform schedule: for comparisons.

    Args:
        name: of the strategy.
        task: see ``Task``; its clock is not used.
        intervals: how many at most; None for the strategy's own number.
        seconds: after which nothing more is begun that can be left out.

    Returns:
        What was found, and whether the time cut the search short.

    Raises:
        CalibrationError: there is no such strategy, or it cannot keep the budget.
        CalibrationFailedError: the time was up before there was a plan within the budget.
    """
    clock = Clock(seconds)
    found, _, stopped = search_plan(open_strategy(name, replace(task, clock=clock)), clock, intervals)
    return found, stopped == "time limit"
