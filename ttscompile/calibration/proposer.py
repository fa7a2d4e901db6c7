"""What proposes plans to the judge: three members each, and a row in the table of ``proposers``.

The command line reads rows; so this module imports neither torch nor those of the proposers. Members as those of the
algorithms of NNCF: whether it applies, what it does, and what it tells.
"""

from __future__ import annotations

import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

from ..artifact.ceiling import BOUND, FARTHEST
from ..core.coercion import Arrays
from ..core.plan import Plan
from ..errors import CalibrationError

if TYPE_CHECKING:
    from ..artifact.load import Artifact
    from ..artifact.manifest import StartRecord
    from ..artifact.stores import BlockWeights
    from .budget import Goal
    from .clock import Clock
    from .judge import Score
    from .task import Search, Task
    from .trials import Trials

SURE = 1.25
"""The upper limit of the distance, with 95 % confidence, may be so many times as far. A plan 0.099 away,
and 0.142 at worst, lost 9 points of success. Where it is near 0 the root of an energy distance has wide limits."""

SAFER = 0.7
"""Of the default's distance: at most so much has the plan ``safe`` where the default is chosen among many."""


def least_bound(distance: float, interval: Sequence[float]) -> float:
    """The smallest bound that a plan this far away is within, by its distance and by the 95 % limits of that."""
    return max(distance, max(interval) / SURE)


def near(distance: float, interval: Sequence[float], bound: float) -> bool:
    """Whether a plan this far away is within a bound; see ``least_bound``."""
    return least_bound(distance, interval) <= bound


@dataclass(frozen=True, eq=False)
class Proposal:
    """A plan, and what has to be written for it.

    Attributes:
        name: that it gets in the artifact, if it is kept.
        plan: what is judged. It may name what the artifact has not, and the fields below bring.
        notes: what is worth keeping about how it was found; JSON. They go into the record under the proposer's name.
        pruner: all constants of the pruner, by name; None leaves them.
        weights: of blocks, by the name that the plan has for them.
        starts: loops that begin with the chunk of the call before, by the name that the plan has for them.
        margin: by how much further from the original than the plan that it was made from it may be: the upper limit of
            the difference over episodes counts (``judge.further``). For plans that cost less; infinite for one that was
            asked for whatever it costs. None: it has to be nearer.
        beside: kept under its name, and not a candidate for the default.
        refusal: says of its score, and of the scores of what was kept so far by name, why it is not what was asked for;
            None if it is. Asked whether or not it is ``beside``.
        shared: fields that the other plans of this calibration get too, if it is kept: of ``Plan``, by name.
    """

    name: str
    plan: Plan
    notes: Mapping[str, Any] = field(default_factory=dict)
    pruner: Arrays | None = None
    weights: Mapping[str, BlockWeights] = field(default_factory=dict)
    starts: Mapping[str, StartRecord] = field(default_factory=dict)
    margin: float | None = None
    beside: bool = False
    refusal: Callable[[Score, Mapping[str, Score]], str | None] = lambda score, others: None
    shared: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Request:
    """What was asked for, as far as proposers read it.

    Attributes:
        correct: whether a correction is fitted to the schedule of a proposer that fits none itself.
        intervals: of a search, at most; None for its own number.
        rank: of the low-rank update to each weight matrix.
        margin: what a proposer allows in place of its own (``Proposal.margin``); None leaves that to it.
        bound: distance from the original that the default may have, see ``near``; for who chooses among loops.
        farthest: that any plan may have, and the default where none is within ``bound``.
        deadline_ms: of a call, for the same; None for the fastest that is near enough.
        by_time: whether plans are chosen by what they take, so that what makes no call faster need not be tried.
    """

    goal: Goal
    correct: bool = False
    intervals: int | None = None
    rank: int = 16
    updates: int = 600
    margin: float | None = None
    bound: float = BOUND
    farthest: float = FARTHEST
    deadline_ms: float | None = None
    by_time: bool = False
    threads: int = 1


Proposals: TypeAlias = Generator[Proposal, bool, None]
"""Each is sent whether the proposal before was kept."""


class Proposer(ABC):
    """Something that learns. Made of a ``Request``.

    ``told`` is a sentence for people on what became of it, once ``propose`` is exhausted or left; ``margin`` its own
    ``Proposal.margin``, or what was asked for in place of that.
    """

    margin = 0.0

    def __init__(self, request: Request) -> None:
        self.request, self.told = request, ""
        if request.margin is not None:
            self.margin = request.margin

    def applies(self, artifact: Artifact) -> str | None:
        """Why it can do nothing for this policy; None if it can. Asked before any work."""
        return None

    @abstractmethod
    def propose(self, trials: Trials, plan: Plan, clock: Clock) -> Proposals:
        """Propose plans made from a plan, the best so far, the most wished for first.

        ``kept = yield Proposal(...)`` tells whether it holds on episodes that nothing was learned from. One that holds
        takes the place of another of its name.

        Args:
            trials: to learn from (``calls``) and to choose on (``learned``); never ``held_out``.
            clock: nothing is begun that would end after its limit, but for what has to be done at least.

        Raises:
            CalibrationFailedError: it found nothing to propose; says why. The calibration ends with that where nobody
                else has found anything.
        """


@dataclass(frozen=True)
class Row:
    """A proposer, as is known before it runs.

    Attributes:
        name: as ``--learn`` has it.
        what: what it learns: the end of a sentence.
        maker: where the class or function is that makes a ``Proposer`` of a ``Request``, as ``module:name`` below
            ``ttscompile``.
        corrects: whether it fits corrections, which need many calls to learn from.
        trains: whether it trains a network on the calls, for which more of them are better.
        consecutive: whether it learns from consecutive calls too (``Trials.windows``).
        anew: whether the plans of an earlier calibration go: what others propose is made from what it does. So one such
            row takes part at most.
        lowers: whether it gives plans another precision, in which all of them are judged again.
        takes: its share of the time, beside those of the others that take part.
    """

    name: str
    what: str
    maker: str
    corrects: bool = False
    trains: bool = False
    consecutive: bool = False
    anew: bool = False
    lowers: bool = False
    takes: float = 1.0

    def make(self, request: Request) -> Proposer:
        """The proposer. Raises ImportError: there is no such module, or it needs a package that is not installed."""
        made: Proposer = pkgutil.resolve_name(f"ttscompile.{self.maker}")(request)
        return made


@dataclass(frozen=True)
class ScheduleRow(Row):
    """A proposer of schedules: ``schedule.Schedule``, with a search of the row's own.

    Attributes:
        maker: where the class or function is that makes a ``Search`` of a ``Task``.
        corrects: whether its schedule is of whole steps, with a correction of the sampler that is fitted to it. Only
            then are there plans for an error budget, and plans beside the target.
        consecutive: whether it learns from consecutive calls, so that its plans may read what an earlier call computed.
        least: how many cells its plans compute at least, of ``(steps, blocks)``; by default those of step 0.
        uses_pruner: whether the pruner may depart from its schedule.
        baseline: whether it is the uniform schedule, which every other one has to beat.
    """

    anew: bool = True
    least: Callable[[int, int], int] = lambda steps, blocks: blocks
    uses_pruner: bool = False
    baseline: bool = False

    def make(self, request: Request) -> Proposer:
        """``Schedule``, which proposes what the search of this row finds."""
        made: Proposer = pkgutil.resolve_name("ttscompile.calibration.schedule:Schedule")(request, self)
        return made

    def search(self, task: Task) -> Search:
        """The search, ready to begin. Raises ImportError or AttributeError: there is no such module, or maker in it."""
        self.require_reach(task.runner.model.steps, task.runner.model.blocks, task.budget)
        made: Search = pkgutil.resolve_name(f"ttscompile.{self.maker}")(task)
        return made

    def require_reach(self, steps: int, blocks: int, budget: int) -> None:
        """Refuse a budget of computed cells, step 0 included, that it cannot keep.

        Raises:
            CalibrationError: it computes more; says how much sparsity it can reach.
        """
        least, cells = self.least(steps, blocks), steps * blocks
        if budget < least:
            raise CalibrationError(
                f"{self.name!r} computes at least {least} of the {steps} x {blocks} cells, a sparsity of"
                f" {1 - least / cells:.4g}; the target of {1 - budget / cells:.4g} leaves {budget}. Lower the target,"
                " or take another proposer."
            )
