"""Keep what plans did in episodes: a row each in the table that the documentation is read against.

    python examples/evaluation/evaluate.py DIR:dense DIR --episodes 640 --looks 2 --json > figures.json
    python examples/evaluation/driven.py figures.json --policy "Push-T, transformer" --plan "8 of 100 steps, int8" \
      --page evidence/results.md#what-build-chooses --name transformer-8

It appends one row for every variant but the first. Sentences of README.md and docs/ that call a plan equivalent name
their rows, and ``tests/examples/test_evaluation_driven.py`` holds them against these.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any

import click
from equivalence import EQUIVALENT, ERROR, FEWEST, SCORE_MARGIN, SUCCESS_MARGIN, TOO_FEW, word_of
from variants import run

TABLE = Path(__file__).resolve().parents[2] / "docs" / "evidence" / "driven.json"
MARGINS: Mapping[str, float] = {"success": 100 * SUCCESS_MARGIN, "score": SCORE_MARGIN}
"""What may be lost, at most: points of success, and of the score."""
Interval = tuple[float, float, float]
"""A difference from the original, and the ends of its interval."""


@dataclass(frozen=True)
class Row:
    """What some paired episodes say of one plan.

    Attributes:
        policy: in words.
        plan: in words.
        episodes: that were paired.
        distance: from the original, as ``build`` and ``calibrate`` print it; None where it is not known.
        success: difference of success in points.
        score: difference of the score.
        comparisons: that share the error of 5 %: rows of one table, times looks at it.
        counted: so many of them the intervals count; all, but in rows that are older than this table.
        verdict: of each measure, in the words of ``equivalence.py``.
        page: below ``docs``, and its section: where the row stands, with its command.
        name: by which sentences cite it; empty where none does.
        command: that drove it; empty in rows that are older than this table.
    """

    policy: str
    plan: str
    episodes: int
    distance: float | None = None
    success: Interval | None = None
    score: Interval | None = None
    comparisons: int = 1
    counted: int = 1
    verdict: Mapping[str, str] = dataclasses.field(default_factory=dict)
    page: str = ""
    name: str = ""
    command: str = ""

    def interval(self, measure: str) -> Interval:
        """The interval of ``success`` or ``score`` that counts all comparisons.

        Where it was printed for fewer, its halves are made wider, as the quantiles of a normal distribution are. That
        is near enough: of 640 pairs Newcombe's own interval for four is as much wider than for one, within 1 %.

        Raises:
            ValueError: the row does not have it.
        """
        found: Interval | None = getattr(self, measure)
        if found is None:
            raise ValueError(f"{self.name or self.plan}: the table does not have its {measure}.")
        mean, low, high = found
        wider = _quantile(self.comparisons) / _quantile(self.counted)
        return mean, mean - wider * (mean - low), mean + wider * (high - mean)

    def word(self, measure: str) -> str:
        """Equivalent, worse or too few episodes, as the interval has it."""
        _, low, high = self.interval(measure)
        word = word_of(low, high, MARGINS[measure])
        return TOO_FEW if measure == "score" and word == EQUIVALENT and self.episodes < FEWEST else word

    def to_json(self) -> str:
        """One line, without what is as usual."""
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        usual = {f.name: f.default for f in dataclasses.fields(self)}
        return json.dumps({key: value for key, value in plain.items() if value != usual[key] and value != {}})


def _quantile(comparisons: int) -> float:
    """How many standard deviations an interval reaches to either side."""
    return NormalDist().inv_cdf(1 - ERROR / comparisons / 2)


def read(path: Path = TABLE) -> list[Row]:
    """The rows of a table, in its order."""
    found = []
    for each in json.loads(path.read_text())["plans"]:
        lists = {key: tuple(each[key]) for key in ("success", "score") if key in each}
        found.append(Row(**(each | lists)))
    return found


def write(rows: Sequence[Row], path: Path = TABLE) -> None:
    """Write a table, a row a line; what it says about itself stays."""
    what = json.dumps(json.loads(path.read_text())["what"])
    lines = ",\n".join(f"  {row.to_json()}" for row in rows)
    path.write_text(f'{{\n "what": {what},\n "plans": [\n{lines}\n ]\n}}\n')


def rows_of(
    figures: Mapping[str, Any], policy: str, plans: Sequence[str], page: str, names: Sequence[str]
) -> list[Row]:
    """Rows of what ``evaluate.py --json`` printed.

    Args:
        figures: the document.
        policy: in words.
        plans: in words, one for each variant but the first.
        page: see ``Row``.
        names: as many, or none.

    Raises:
        ValueError: there is another number of plans or names.
    """
    variants = figures["variants"][1:]
    if len(plans) != len(variants) or len(names) not in (0, len(plans)):
        raise ValueError(
            f"expected a plan, and a name or none, for each of the {len(variants)} variants after the first; found"
            f" {len(plans)} plans and {len(names)} names."
        )
    made = []
    for variant, plan, name in zip(variants, plans, names or [""] * len(plans), strict=True):
        verdict = variant["verdict"]
        (success, score) = (
            tuple(round(scale * verdict[measure]["difference"][end], digits) for end in ("mean", "low", "high"))
            for measure, scale, digits in (("success", 100, 2), ("score", 1, 4))
        )
        comparisons = verdict["success"]["comparisons"]
        made.append(
            Row(
                policy,
                plan,
                verdict["success"]["episodes"],
                variant["distance"],
                success,
                score,
                comparisons,
                comparisons,
                {measure: verdict[measure]["word"] for measure in MARGINS},
                page,
                name,
                figures["command"],
            )
        )
    return made


@click.command()
@click.argument("figures", type=click.File())
@click.option("--policy", required=True, help="In words.")
@click.option("--plan", "plans", required=True, multiple=True, help="In words; one for each variant but the first.")
@click.option("--page", required=True, help="PAGE.md#SECTION below docs: where the row stands, with its command.")
@click.option("--name", "names", multiple=True, help="By which sentences cite it; one for each plan.")
@click.option("--table", default=TABLE, type=click.Path(dir_okay=False, exists=True, path_type=Path))
def main(figures: Any, policy: str, plans: tuple[str, ...], page: str, names: tuple[str, ...], table: Path) -> None:
    """Append a row for every variant but the first of what evaluate.py --json printed."""
    try:
        made = rows_of(json.load(figures), policy, plans, page, names)
    except ValueError as e:
        raise click.UsageError(str(e)) from e
    write([*read(table), *made], table)
    for row in made:
        click.echo(f"{row.policy}, {row.plan}: {', '.join(f'{key} {word}' for key, word in row.verdict.items())}")


if __name__ == "__main__":
    run(main)
