"""What proposes plans to the judge: three members each, and a row in ``PROPOSERS``.

The command line reads names and what they tell here; so this module imports neither torch nor those of the proposers.
Members as those of the algorithms of NNCF: whether it applies, what it does, and what it tells.
"""

from __future__ import annotations

import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy.typing as npt

from ..artifact.ceiling import BOUND, FARTHEST
from ..core.plan import SCHEDULE, Plan
from ..errors import CalibrationError

if TYPE_CHECKING:
    from ..artifact.load import Artifact
    from ..artifact.manifest import StartRecord
    from ..artifact.stores import BlockWeights
    from .budget import Goal
    from .clock import Clock
    from .judge import Score
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
    pruner: Mapping[str, npt.NDArray[Any]] | None = None
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
        strategy: how schedules are found; a name of ``strategies``.
        correct: whether a correction is fitted to what a strategy finds that fits none itself.
        intervals: of a search, at most; None for its own number.
        rank: of the low-rank update to each weight matrix.
        margin: what a proposer allows in place of its own (``Proposal.margin``); None leaves that to it.
        bound: distance from the original that the default may have, see ``near``; for who chooses among loops.
        farthest: that any plan may have, and the default where none is within ``bound``.
        deadline_ms: of a call, for the same; None for the fastest that is near enough.
        by_time: whether plans are chosen by what they take, so that what makes no call faster need not be tried.
    """

    goal: Goal
    strategy: str = "tts"
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
        corrects: whether it fits corrections, which need many calls to learn from; of a schedule its strategy says so.
        trains: whether it trains a network on the calls, for which more of them are better.
        consecutive: whether it learns from consecutive calls too (``Trials.windows``).
        anew: whether the plans of an earlier calibration go: all that follows is made from what it proposes.
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


LOOPS = "loops"
"""The proposer after which the default is chosen among all plans that were kept (``choose``)."""

PROPOSERS = (
    Row(SCHEDULE, "which steps are computed, with corrections and jumps", "calibration.schedule:Schedule", anew=True),
    Row(
        LOOPS,
        "which loop, and how few of its steps; the default is chosen at the end",
        "calibration.proposers.loops:Loops",
        corrects=True,
        anew=True,
        takes=6.0,
    ),
    Row("pruner", "gates for each observation", "calibration.proposers.pruner:Pruner", consecutive=True),
    Row(
        "precision",
        "which parts compute in the other precision",
        "calibration.proposers.precision:Precision",
        lowers=True,
    ),
    Row("tokens", "when a token of an image encoder is computed anew", "calibration.proposers.tokens:Tokens"),
    Row(
        "weights",
        "low-rank updates of later steps' weights",
        "calibration.proposers.weights:Weights",
        corrects=True,
        trains=True,
    ),
    Row("start", "how many steps a call needs that begins with the chunk before", "calibration.proposers.start:Start"),
)
"""In the order in which they propose, whatever the order in which they are asked for."""

NAMES = tuple(row.name for row in PROPOSERS)


def rows_of(learn: tuple[str, ...]) -> tuple[Row, ...]:
    """The rows of these names, in the order of ``PROPOSERS``."""
    unknown = [name for name in learn if name not in NAMES]
    if unknown or not learn:
        found = repr(unknown[0]) if unknown else "none"
        raise CalibrationError(f"learn: expected some of {', '.join(NAMES)}; found {found}.")
    return tuple(row for row in PROPOSERS if row.name in learn)
