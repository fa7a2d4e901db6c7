"""What ``ttscompile bench`` found, as one report: times, whether they fit a loop, action errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from ttscompile.cli.comparison import print_comparison
from ttscompile.cli.loop import LoopReport
from ttscompile.cli.output import say
from ttscompile.cli.summary import print_facts
from ttscompile.core.spec import FP32
from ttscompile.report.timing import Measurement, timing_remarks, timing_table

if TYPE_CHECKING:
    from rich.console import Console

    from ttscompile.measure.points import Comparison

WORTH = 0.1
"""Share of a call's time that more threads have to save: they take their cores from the rest of the robot."""


def fewest_threads(medians: Mapping[int, float]) -> int:
    """The smallest number of threads that no other one is faster than by more than ``WORTH``; ``medians`` by number."""
    bound = min(medians.values()) / (1 - WORTH)
    return min(number for number, median in medians.items() if median <= bound)


@dataclass(frozen=True)
class PrecisionError:
    """How far executed actions of dense calls are from those in fp32, with equal noise, in their units.

    Attributes:
        p90: 90th percentile over the calls.
    """

    precision: str
    calls: int
    mean: float
    p90: float
    largest: float


@dataclass(frozen=True)
class BenchReport:
    """What was found.

    Attributes:
        by_threads: median of one plan in ms by its number of threads.
        error: of dense calls in a precision that a runtime makes; None if no plan asks for one.
        loop: which plans keep up; None if that was not asked.
        compared: action errors; None without recordings.
        chosen: which plan is the default now; None if that was not asked, or no plan is fast enough.
    """

    measured: Sequence[Measurement]
    default: str
    calls: int
    by_threads: Mapping[int, float]
    error: PrecisionError | None
    loop: LoopReport | None
    compared: Comparison | None
    chosen: str | None

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {
            "calls": self.calls,
            "threads": list(self.by_threads),
            "best_threads": fewest_threads(self.by_threads),
            "contestants": [m.to_json() for m in self.measured],
            "precision_error": None if self.error is None else asdict(self.error),
            "loop": None if self.loop is None else self.loop.to_json(),
            "comparison": None if self.compared is None else self.compared.to_json(),
            "chosen": self.chosen,
        }

    def print(self, output: Console) -> None:
        """As tables, each with what it is of."""
        print_facts(output, timing_table(self.measured, self.default, ("prologue", "frames", "pruner")))
        say(output, timing_remarks(self.measured, self.calls))
        if len(self.by_threads) > 1:
            best = fewest_threads(self.by_threads)
            say(output, f"Load it with threads={best}: more of these save less than {WORTH:.0%} of a call.")
        if (error := self.error) is not None:
            say(
                output,
                f"Actions of {error.calls} dense calls in {error.precision} are {error.mean:.4g} off those in {FP32} on"
                f" average, {error.p90:.4g} at the 90th percentile, {error.largest:.4g} at most, in their units.",
            )
        if self.loop is not None:
            self.loop.print(output)
        if self.compared is not None:
            print_comparison(self.compared, output)
        if self.chosen is not None:
            say(output, self.chosen)
