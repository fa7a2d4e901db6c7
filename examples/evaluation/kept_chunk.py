"""Does it pay to go on with the chunk of the call before, where one evaluation says that it still holds?

    python examples/evaluation/kept_chunk.py DIR OTHER@4 --horizon 4 --every 4,8 --warm 2 --environment pusht:moved

A call comes every ``--horizon`` actions. It draws a chunk, or goes on with the one before while that has actions left.
DIR's plan draws; other plans draw in every call, as DIR's does in rows of ``--every``, and so do the last steps of the
whole loop, from the chunk before, in rows of ``--warm``.

- ``check`` spends one evaluation: the chunk before, moved by what was executed, with noise as before step ``--step`` of
  the whole loop, and the newest observation. The call draws where the network's clean chunk is further from that chunk
  than a threshold. FLASH (arXiv 2605.13778) checks what a small model drafted so.
- ``answered`` is the same, and executes the clean chunk where it is near enough.
- ``blind`` is ``check`` with the pictures that the chunk was drawn with, whose features are known.
- ``forecast`` spends none: a linear map of the observation and the actions of the call before says what is observed
  now, and the call draws where that is wrong.
- ``chance`` draws by chance; with a share of 0 it goes on until a chunk is used up.

Thresholds are quantiles over episodes that nothing is judged on, and which go on whenever they can; ``--shares`` are
those of the checks that fail there. Maps are fitted on the same episodes. Milliseconds are those of calls of each kind
(``kept_times.py``), by how often each was made.

Where somebody moves a block (``NAME:moved``), all is driven without that, too. A policy has reacted once an action
differs by ``REACTED`` of the actions' range from that of the episode in which the block stays.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import numpy as np
from doubts import Array, Chance, Check, Doubt, Forecast
from environments import environment_class, environment_option
from evaluate import Evaluation, summarise
from keeping import Keeping, active
from kept_times import Stopwatch, Times, warmed
from rich.table import Table
from rollout import Episode, Rollout, run_episodes
from variants import Variant, batch_option, first_seed_option, json_option, open_variant, results_console, run
from warm_start import WARM

from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import ChunkSpec
from ttscompile.errors import TtscompileError

REACTED = 0.1
"""Of the range of each action, by which one differs from that of an episode in which nothing was moved."""

TIMED = 4
"""Episodes whose calls are timed."""

RULES = ("check", "answered", "blind", "forecast", "chance")


@dataclass(frozen=True)
class Way:
    """How to drive: a label, what draws, actions from call to call, what doubts, and the share of checks to fail."""

    label: str
    variant: Variant
    horizon: int
    doubt: Doubt | None = None
    share: float = 0.0


@dataclass(frozen=True)
class Row:
    """What came of one way.

    Attributes:
        steps: evaluations that are steps of the loop, for each action.
        checks: evaluations that check a chunk, likewise.
        ms: milliseconds of calls, likewise.
        times: milliseconds of a call, by its kind.
        anew: share of the calls that could have gone on, and drew.
        evaluation: against the first row.
        still: the same where nothing is moved; None where nothing is in any case.
        reaction: actions until the policy acts otherwise: the median, and 90 % of the episodes.
    """

    steps: float
    checks: float
    ms: float
    times: Mapping[str, float]
    anew: float | None
    evaluation: Evaluation
    still: Evaluation | None
    reaction: tuple[float, float] | None

    def cells(self, actions: int) -> list[str]:
        """For the table; evaluations and milliseconds are of so many actions."""
        told = [f"{actions * one:.2f}" for one in (self.steps + self.checks, self.checks, self.ms)]
        told.append("" if self.anew is None else f"{self.anew:.0%}")
        for one in (self.evaluation, self.still):
            if one is not None:
                differences = one.score_difference, one.success_difference
                told += [str(one.score), str(one.success), *("" if each is None else str(each) for each in differences)]
        return [self.evaluation.label, *told, *([] if self.reaction is None else [f"{n:g}" for n in self.reaction])]

    def to_json(self) -> dict[str, Any]:
        """The figures, and the score of every seed."""
        evaluations = {name: getattr(self, name) for name in ("evaluation", "still")}
        return vars(self) | {name: one and one.to_json() for name, one in evaluations.items()}


def reactions(moved: Sequence[Episode], still: Sequence[Episode]) -> tuple[float, float]:
    """See ``Row``. Episodes in which nothing was moved do not count; those that end before a reaction do."""
    wide, found = np.ptp(np.concatenate([one.actions for one in still]), axis=0), []
    for one, other in zip(moved, still, strict=True):
        if (at := int(one.measures["moved at"])) >= 0:
            length = min(len(one.actions), len(other.actions))
            apart = np.abs(one.actions[at:length] - other.actions[at:length]) > REACTED * wide
            differs = np.flatnonzero(apart.any(1))
            found.append(int(differs[0]) if len(differs) else length - at)
    return float(np.median(found)), float(np.quantile(found, 0.9))


class Bench:
    """Where ways are driven.

    Args:
        environment: its name.
        chunk: what of a sample is action.
        batch: episodes in lockstep.
        learned: seeds of the episodes that thresholds and forecasts are of.
        calls: of each kind that are timed.
    """

    def __init__(self, environment: str, chunk: ChunkSpec, batch: int, learned: Sequence[int], calls: int) -> None:
        make: Any = environment_class(environment)
        self._make, self._chunk, self._batch, self._learned, self._calls = make, chunk, batch, learned, calls
        self._still = type("Still", (make,), {"moves": False}) if hasattr(make, "moves") else None
        self._known: dict[tuple[int, int], Array] = {}
        self._times: dict[tuple[str, int], Mapping[str, float]] = {}

    def forecast(self, variant: Variant, horizon: int) -> Forecast:
        """Fitted on episodes that go on whenever they can."""
        keeping, rollout = self._driven(Way("", variant, horizon, Chance()), np.inf, self._still, self._learned)
        known, seen = (active(keeping.batches, name, rollout.episodes) for name in ("known", "seen"))
        return Forecast.fit(np.concatenate([one[:-1] for one in known]), np.concatenate([one[1:] for one in seen]))

    def threshold(self, way: Way) -> float:
        """Above which distance the way's share of the checks fails."""
        if way.doubt is None or isinstance(way.doubt, Chance):
            return 1 - way.share
        if (key := (id(way.doubt), way.horizon)) not in self._known:
            keeping, rollout = self._driven(way, np.inf, self._still, self._learned)
            told = np.concatenate(active(keeping.batches, "distances", rollout.episodes))
            self._known[key] = told[np.isfinite(told)]
        return float(np.quantile(self._known[key], 1 - way.share))

    def times(self, way: Way) -> Mapping[str, float]:
        """Milliseconds of calls of the way's artifact and plan, by kind."""
        if (key := (way.variant.label, way.horizon)) not in self._times:
            driven = self._driven(Way("", way.variant, way.horizon), np.inf, self._still, self._learned[:TIMED])[1]
            windows = [[{n: a[i] for n, a in one.windows.items()} for i in range(one.calls)] for one in driven.episodes]
            pairs = [pair for one in windows for pair in pairwise(one)][: self._calls]
            self._times[key] = Stopwatch(*key).times(pairs)
        return self._times[key]

    def rows(self, ways: Sequence[Way], seeds: Sequence[int], tell: Callable[[str], None]) -> list[Row]:
        """Every way on every seed."""
        rows, first, first_still = list[Row](), None, None
        tell("times")
        times = [self.times(way) for way in ways]
        for way, own in zip(ways, times, strict=True):
            tell(way.label)
            keeping, rollout = self._driven(way, threshold := self.threshold(way), self._make, seeds)
            first, still, reaction = first or rollout, None, None
            if self._still is not None:
                left_alone = self._driven(way, threshold, self._still, seeds)[1]
                first_still = first_still or left_alone
                still = summarise(way.label, left_alone, first_still)
                reaction = reactions(rollout.episodes, left_alone.episodes)
            actions = sum(len(one.actions) for one in rollout.episodes)
            names = "steps", "checked", "drawn"
            steps, checked, drawn = (np.concatenate(active(keeping.batches, n, rollout.episodes)) for n in names)
            checks = 0 if way.doubt is None else way.doubt.evaluations * int(checked.sum())
            anew = float(drawn[checked].mean()) if checked.any() else None
            found, took = summarise(way.label, rollout, first), Times.by(own, way.doubt).of(drawn, checked)
            evaluations, ms = float(steps.sum()) / actions, float(took.sum()) / actions
            rows.append(Row(evaluations, checks / actions, ms, own, anew, found, still, reaction))
        return rows

    def _driven(self, way: Way, threshold: float, make: Any, seeds: Sequence[int]) -> tuple[Keeping, Rollout]:
        keeping = Keeping(way.variant, self._chunk, way.horizon, way.doubt, threshold)
        return keeping, run_episodes(make or self._make, replace(way.variant, policy=keeping), seeds, self._batch)


def _listed(kind: Callable[[str], Any]) -> Callable[[Any, Any, str], list[Any]]:
    """The callback of an option with commas between its values."""

    def parsed(_: Any, __: Any, text: str) -> list[Any]:
        try:
            return [kind(word) for word in text.split(",") if word]
        except ValueError as error:
            raise click.BadParameter(f"{error}.") from error

    return parsed


def _rule(word: str) -> str:
    if word not in RULES:
        raise ValueError(f"{word!r} is no rule; expected some of {', '.join(RULES)}")
    return word


def _share(word: str) -> float:
    if not 0 <= (share := float(word)) <= 1:
        raise ValueError(f"{word} is no share of 0 to 1")
    return share


def _actions(word: str) -> int:
    if (count := int(word)) < 1:
        raise ValueError(f"{count} is below 1")
    return count


@click.command(context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@click.argument("others", nargs=-1, metavar="[DIR:PLAN@HORIZON...]")
@click.option("--horizon", default=4, type=click.IntRange(1), help="Actions from one call to the next.")
@click.option("--every", default="4,8", callback=_listed(_actions), help="Horizons of calls that all draw.")
@click.option("--warm", default="", callback=_listed(_actions), help="Last steps of calls that begin with a chunk.")
@click.option("--step", default=5, type=click.IntRange(1), help="Of the whole loop, whose noise a check has.")
@click.option("--rules", default="check,chance", callback=_listed(_rule), help=f"Of {', '.join(RULES)}.")
@click.option("--shares", default="0.25,0.5,0.75", callback=_listed(_share), help="Of the checks, that shall fail.")
@click.option("--chances", default="0", callback=_listed(_share), help="Likewise, by chance.")
@click.option("--learned", default=32, type=click.IntRange(1), help="Episodes for thresholds and maps, from seed 0.")
@click.option("--calls", default=40, type=click.IntRange(2), help="Of each kind, that are timed.")
@environment_option
@click.option("--episodes", default=200, type=click.IntRange(1))
@first_seed_option
@batch_option
@json_option
def main(
    directory: Path,
    others: tuple[str, ...],
    horizon: int,
    every: list[int],
    warm: list[int],
    step: int,
    rules: list[str],
    shares: list[float],
    chances: list[float],
    learned: int,
    calls: int,
    environment: str,
    episodes: int,
    first_seed: int,
    batch: int,
    as_json: bool,
) -> None:
    """Drive DIRECTORY's plan with rules about going on, and other plans."""
    chunk = load_artifact(directory).manifest.spec.chunk
    if chunk.relative is not None or chunk.switches:
        raise TtscompileError(f"{directory}: its actions are relative, or switches; chunks of those are not kept here.")
    bench = Bench(environment, chunk, batch, range(learned), calls)
    with TemporaryDirectory() as folder:
        copy = warmed(directory, sorted({1, *warm}), Path(folder))
        own = open_variant(str(copy), "onnxruntime", 1)
        ways = [Way(f"every {h} actions", own, h) for h in every]
        for text in others:
            name, _, h = text.partition("@")
            ways.append(Way(text, open_variant(name, "onnxruntime", 1), int(h or horizon)))
        for last in warm:
            ways.append(Way(f"warm, {last}", open_variant(f"{copy}:{WARM}-{last}", "onnxruntime", 1), horizon))
        doubts: dict[str, Callable[[], Doubt]] = {
            "check": lambda: Check(directory, step),
            "answered": lambda: Check(directory, step, answered=True),
            "blind": lambda: Check(directory, step, blind=True),
            "forecast": lambda: bench.forecast(own, horizon),
            "chance": Chance,
        }
        for rule in rules:
            doubt = doubts[rule]()
            some = chances if rule == "chance" else shares
            ways += [Way(f"{rule}, {share:g}", own, horizon, doubt, share) for share in some]
        rows = bench.rows(ways, range(first_seed, first_seed + episodes), lambda label: click.echo(label, err=True))
    if as_json:
        click.echo(json.dumps([row.to_json() for row in rows]))
        return
    results_console().print(_drawn(rows, environment, chunk.stop - chunk.start))


def _drawn(rows: Sequence[Row], environment: str, actions: int) -> Table:
    count = len(rows[0].evaluation.rollout.episodes)
    title = f"{environment}: {count} paired episodes; evaluations of the network and milliseconds in {actions} actions"
    table = Table(title=title, caption=f"Milliseconds of a call of DIR: {_listing(rows[0].times)}.")
    scores = "score", "success", "score, difference", "success, difference"
    left_alone = [f"{name}; left alone" for name in scores] if rows[0].still is not None else []
    reaction = ["reaction", "of 90 %"] if rows[0].reaction is not None else []
    for column in ("", "evaluations", "checks", "ms", "anew", *scores, *left_alone, *reaction):
        table.add_column(column, justify="right" if column else "left")
    for row in rows:
        table.add_row(*row.cells(actions))
    return table


def _listing(times: Mapping[str, float]) -> str:
    return ", ".join(f"{kind} {ms:.2f}" for kind, ms in times.items())


if __name__ == "__main__":
    run(main)
