"""Does it pay to go on with the chunk of the call before, where one evaluation says that it still holds?

    python examples/evaluation/kept_chunk.py DIR OTHER@4 --horizon 4 --every 8,4 --environment pusht:moved

A call comes every ``--horizon`` actions. It draws a chunk, or goes on with the one before while that has actions left.
DIR's plan draws; other plans, such as warm starts, draw in every call, as DIR's does in rows of ``--every``.

- ``check`` spends one evaluation: the chunk before, moved by what was executed, with noise as before step ``--step`` of
  the whole loop, and the newest observation. The call draws where the network's clean chunk is further from that chunk
  than a threshold. FLASH (arXiv 2605.13778) checks what a small model drafted so.
- ``answered`` is the same, and executes the clean chunk where it is near enough.
- ``forecast`` spends none: a linear map of the observation and the actions of the call before says what is observed
  now, and the call draws where that is wrong.
- ``chance`` draws by chance; with a share of 0 it goes on until a chunk is used up.

Thresholds are quantiles over episodes that nothing is judged on, and which go on whenever they can; ``--shares`` are
those of the checks that fail there. Maps are fitted on the same episodes.

Where somebody moves a block (``NAME:moved``), all is driven without that, too. A policy has reacted once an action
differs by ``REACTED`` of the actions' range from that of the episode in which the block stays.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from doubts import Array, Chance, Check, Doubt, Forecast, Going, flat
from environments import environment_class, environment_option
from evaluate import Evaluation, summarise
from rich.table import Table
from rollout import Episode, Rollout, run_episodes
from variants import Variant, batch_option, first_seed_option, json_option, open_variant, results_console, run

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.core.lattice import Source
from ttscompile.core.spec import ChunkSpec
from ttscompile.errors import TtscompileError
from ttscompile.runtimes.info import PolicyInfo

REACTED = 0.1
"""Of the range of each action, by which one differs from that of an episode in which nothing was moved."""

RULES = ("check", "answered", "forecast", "chance")


@dataclass
class Slots:
    """What calls of a batch of episodes did, in order: arrays with a row for each stream.

    Attributes:
        drawn: whether a chunk was drawn.
        checked: whether the one before had enough actions left to go on.
        steps: evaluations of the loop.
        distances: of the doubt; NaN where there was none.
        known: the observation, and what is executed.
        seen: the observation.
    """

    drawn: list[Array] = field(default_factory=list)
    checked: list[Array] = field(default_factory=list)
    steps: list[Array] = field(default_factory=list)
    distances: list[Array] = field(default_factory=list)
    known: list[Array] = field(default_factory=list)
    seen: list[Array] = field(default_factory=list)


class Keeping:
    """A policy that goes on with chunks.

    Args:
        variant: what draws.
        chunk: what of a sample is action.
        horizon: actions from one call to the next.
        doubt: that decides; None where each call draws.
        threshold: above which distance a chunk is drawn.
    """

    def __init__(
        self, variant: Variant, chunk: ChunkSpec, horizon: int, doubt: Doubt | None = None, threshold: float = np.inf
    ) -> None:
        self._variant, self._chunk, self._horizon = variant, chunk, horizon
        self._doubt, self._threshold = doubt, threshold
        self.info: PolicyInfo = variant.policy.info
        self.batches: list[Slots] = []

    def reset(self) -> None:
        """A new episode."""
        self._variant.policy.reset()
        if self._doubt is not None:
            self._doubt.reset()
        self._going: Going | None = None
        self.batches.append(Slots())

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: ttscompile.Noise | None = None, plan: object = None
    ) -> Mapping[str, Any]:
        """One call. All streams are drawn anew, but only those that have to be are counted."""
        assert noise is not None
        chunk, h, log, going, seen = self._chunk, self._horizon, self.batches[-1], self._going, flat(obs_dict)
        made, steps = self._drawn(obs_dict, noise)
        fresh, whole = noise.initial[:, : made.shape[1]], np.full(len(made), made.shape[1] - chunk.start)
        after, noises, left = made, fresh, whole
        drawn, checked, distances = np.ones(len(made), np.bool_), whole < 0, np.full(len(made), np.nan)
        if going is not None and self._doubt is not None:
            verdict = self._doubt.judge(obs_dict, fresh, going)
            answered = verdict.clean is not None
            checked = (going.left >= h) | answered
            drawn = ~checked | (verdict.distances > self._threshold)
            distances = np.where(checked, verdict.distances, np.nan)
            old = drawn[:, None, None], going.chunk if verdict.clean is None else verdict.clean
            after, noises = np.where(old[0], made, old[1]), np.where(old[0], fresh, going.noise)
            left = np.where(drawn | answered, whole, going.left)
        done = after[:, chunk.start : chunk.start + h].reshape(len(made), -1)
        told = drawn, checked, steps * drawn, distances, np.concatenate([seen, done], 1), seen
        for name, array in zip(("drawn", "checked", "steps", "distances", "known", "seen"), told, strict=True):
            getattr(log, name).append(array)
        noises = np.concatenate([noises[:, h:], fresh[:, :h]], 1)
        self._going = Going(chunk.moved(after, h), noises, left - h, seen, done)
        return {"action": chunk.unnormalized(after)[:, chunk.start : chunk.start + h]}

    def _drawn(self, obs: Mapping[str, Any], noise: ttscompile.Noise) -> tuple[Array, Array]:
        """Chunks ``[B, T, D]``, normalised, and how many evaluations each took."""
        policy: Any = self._variant.policy
        if self._going is not None:
            policy.follow(self._horizon)
        predicted = policy.predict_action(obs, noise=noise, plan=self._variant.plan)["action_pred"]
        computed = (policy.last_report.plan == Source.COMPUTE).any(-1).sum(-1)
        return self._chunk.normalized(np.asarray(predicted)), computed


def active(slots: Sequence[Slots], name: str, episodes: Sequence[Episode]) -> list[Array]:
    """What is known of the calls of each episode, in order, while it was not done."""
    columns = [(one, i) for one in slots for i in range(len(one.drawn[0]))]
    arrays = ([row[i] for row in getattr(one, name)] for one, i in columns)
    return [np.stack(rows[: episode.calls]) for rows, episode in zip(arrays, episodes, strict=True)]


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
        anew: share of the calls that could have gone on, and drew.
        evaluation: against the first row.
        still: the same where nothing is moved; None where nothing is in any case.
        reaction: actions until the policy acts otherwise: the median, and 90 % of the episodes.
    """

    steps: float
    checks: float
    anew: float | None
    evaluation: Evaluation
    still: Evaluation | None
    reaction: tuple[float, float] | None

    def cells(self, actions: int) -> list[str]:
        """For the table; evaluations are of so many actions."""
        told = [f"{actions * one:.2f}" for one in (self.steps + self.checks, self.checks)]
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
    """

    def __init__(self, environment: str, chunk: ChunkSpec, batch: int, learned: Sequence[int]) -> None:
        make: Any = environment_class(environment)
        self._make, self._chunk, self._batch, self._learned = make, chunk, batch, learned
        self._still = type("Still", (make,), {"moves": False}) if hasattr(make, "moves") else None
        self._known: dict[tuple[int, int], Array] = {}

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

    def rows(self, ways: Sequence[Way], seeds: Sequence[int], tell: Callable[[str], None]) -> list[Row]:
        """Every way on every seed."""
        rows, first, first_still = list[Row](), None, None
        for way in ways:
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
            found = summarise(way.label, rollout, first)
            rows.append(Row(float(steps.sum()) / actions, checks / actions, anew, found, still, reaction))
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
@click.option("--every", default="8,4", callback=_listed(_actions), help="Horizons of calls that all draw.")
@click.option("--step", default=5, type=click.IntRange(1), help="Of the whole loop, whose noise a check has.")
@click.option("--rules", default="check,chance", callback=_listed(_rule), help=f"Of {', '.join(RULES)}.")
@click.option("--shares", default="0.25,0.5,0.75", callback=_listed(_share), help="Of the checks, that shall fail.")
@click.option("--chances", default="0", callback=_listed(_share), help="Likewise, by chance.")
@click.option("--learned", default=32, type=click.IntRange(1), help="Episodes for thresholds and maps, from seed 0.")
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
    step: int,
    rules: list[str],
    shares: list[float],
    chances: list[float],
    learned: int,
    environment: str,
    episodes: int,
    first_seed: int,
    batch: int,
    as_json: bool,
) -> None:
    """Drive DIRECTORY's plan with rules about going on, and other plans."""
    own, chunk = open_variant(str(directory), "onnxruntime", 1), load_artifact(directory).manifest.spec.chunk
    if chunk.relative is not None or chunk.switches:
        raise TtscompileError(f"{directory}: its actions are relative, or switches; chunks of those are not kept here.")
    bench = Bench(environment, chunk, batch, range(learned))
    ways = [Way(f"every {h} actions", own, h) for h in every]
    for text in others:
        name, _, h = text.partition("@")
        ways.append(Way(text, open_variant(name, "onnxruntime", 1), int(h or horizon)))
    doubts: dict[str, Callable[[], Doubt]] = {
        "check": lambda: Check(directory, step),
        "answered": lambda: Check(directory, step, answered=True),
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
    table = Table(title=f"{environment}: {count} paired episodes; evaluations of the network in {actions} actions")
    scores = "score", "success", "score, difference", "success, difference"
    left_alone = [f"{name}; left alone" for name in scores] if rows[0].still is not None else []
    reaction = ["reaction", "of 90 %"] if rows[0].reaction is not None else []
    for column in ("", "evaluations", "checks", "anew", *scores, *left_alone, *reaction):
        table.add_column(column, justify="right" if column else "left")
    for row in rows:
        table.add_row(*row.cells(actions))
    return table


if __name__ == "__main__":
    run(main)
