"""What ``ttscompile bench`` found, as one report: times, whether they fit a loop, action errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ttscompile.cli.comparison import print_comparison
from ttscompile.cli.loop import LoopReport
from ttscompile.cli.output import say
from ttscompile.cli.summary import print_facts
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
class BenchReport:
    """What was found.

    Attributes:
        by_threads: median of one plan in ms by its number of threads.
        loop: which plans keep up; None if that was not asked.
        compared: action errors; None without recordings.
        chosen: which plan is the default now; None if that was not asked, or no plan is fast enough.
    """

    measured: Sequence[Measurement]
    default: str
    calls: int
    by_threads: Mapping[int, float]
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
        if self.loop is not None:
            self.loop.print(output)
        if self.compared is not None:
            print_comparison(self.compared, output)
        if self.chosen is not None:
            say(output, self.chosen)
