"""What do rules gain that decide about whole calls: where one begins, whether there is one, and what it looks at?

    ttscompile convert examples/pusht/pusht_dpt_ema_fp16.ckpt -o DIR --sampler ddim --steps 16
    python examples/evaluation/whole_calls.py DIR --falcon 0.3:8,0.1:8 --light 4,8 --environment pusht --episodes 32

All drive the same loop on paired episodes, and plans of DIR beside them. What counts is how many evaluations of the
network a call takes on average: a rule that leaves some out has to beat a plan with as few.

**Falcon** (arXiv 2503.00339) keeps the samples of the call before at every noise level, moved by what was executed. It
makes a clean chunk of each in one evaluation, with the new observation, and begins with the least noisy one whose chunk
is nearer than a threshold to what the call before planned; with none, or by chance, with noise. ``0.02:8`` is that
threshold, and how many steps a call has at least, the paper's k_min. Without it the last step alone would be left: a
sample that is hardly noisy is its own chunk. The paper's buffer has samples of several calls; here it has those of
the last one. All of them are looked at in one evaluation of many rows, as the paper has it; with ``--apart`` one after
the other, which finds the same. Steps and rows are counted, and the milliseconds of looking.

**SP-VLA** (arXiv 2506.12723) leaves out the call where the last action was fast, and extrapolates: a ridge regression
of the last actions on time. The call after it is always made, where the paper has a share of real actions. Its tokens
are another matter (``--learn tokens``).

**Kept pictures**, as FLASH (arXiv 2605.13778) keeps them between two looks: with ``--look 2`` every second call has the
pictures of the call before, whose features are known, and the state of now.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
from environments import environment_class, environment_option
from evaluate import Evaluation, evaluate
from falcon import Count, Falcon
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from variants import (
    Variant,
    batch_option,
    first_seed_option,
    full_plan,
    json_option,
    open_variant,
    results_console,
    run,
)

import ttscompile
from ttscompile.core.spec import FloatArray

MEMORY, RIDGE = 8, 1e-3
"""SP-VLA's actions to extrapolate from, and the ridge of the regression."""

Array = npt.NDArray[Any]


def extrapolated(actions: FloatArray, count: int) -> FloatArray:
    """The next actions ``[count, Da]`` by a ridge regression of those before ``[M, Da]`` on time."""
    times = np.arange(-len(actions), count, dtype=np.float64)
    design = np.stack([np.ones_like(times), times / len(actions)], 1)
    past = design[: len(actions)]
    weights = np.linalg.solve(past.T @ past + RIDGE * np.diag([0, 1]), past.T @ actions)
    return (design[len(actions) :] @ weights).astype(np.float32)


class Light:
    """A policy whose calls are left out where the robot is fast.

    Args:
        variant: the policy, and its plan.
        steps: evaluations of one of its calls.
        fast: how far an action is from the one before, or, where actions are displacements, from 0.
        displacements: whether they are.
    """

    def __init__(self, variant: Variant, steps: int, fast: float, displacements: bool) -> None:
        self._variant, self._steps, self._fast, self._displacements = variant, steps, fast, displacements
        self.info, self.count = variant.policy.info, Count()
        self.reset()

    def reset(self) -> None:
        """A new episode."""
        self._variant.policy.reset()
        self._past: dict[int, FloatArray] = {}  # by stream
        self._left_out: set[int] = set()  # the streams whose last call was

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: ttscompile.Noise | None = None, plan: object = None
    ) -> Mapping[str, Any]:
        """One call. All streams are answered by the policy, but only those that are not left out are counted."""
        made = self._variant.policy.predict_action(obs_dict, noise=noise, plan=self._variant.plan)["action"]
        actions = np.array(made)
        known = {i: past for i, past in self._past.items() if i not in self._left_out}
        self._left_out = {i for i, past in known.items() if _speed(past, self._displacements) > self._fast}
        for i in range(len(actions)):
            if i in self._left_out:
                actions[i] = extrapolated(self._past[i], len(actions[i]))
            self._past[i] = np.concatenate([self._past.get(i, actions[i][:0]), actions[i]])[-MEMORY:]
        self.count.calls += len(actions)
        self.count.steps += self._steps * (len(actions) - len(self._left_out))
        return {"action": actions}


class Kept:
    """A policy that looks at every so many calls, and has the newest state at all of them.

    Args:
        variant: the policy, and its plan.
        steps: evaluations of one of its calls.
        look: at the first of so many calls.
    """

    def __init__(self, variant: Variant, steps: int, look: int) -> None:
        self._variant, self._steps, self._look = variant, steps, look
        self.info, self.count, self._pictures, self._number = variant.policy.info, Count(), dict[str, Array](), 0

    def reset(self) -> None:
        """A new episode."""
        self._variant.policy.reset()
        self._number = 0

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: ttscompile.Noise | None = None, plan: object = None
    ) -> Mapping[str, Any]:
        """One call."""
        if self._number % self._look == 0:
            self._pictures = {key: np.array(obs_dict[key]) for key, one in self.info.observation.items() if one.image}
        self._number += 1
        streams = len(next(iter(obs_dict.values())))
        self.count.calls += streams
        self.count.steps += self._steps * streams
        return self._variant.policy.predict_action({**obs_dict, **self._pictures}, noise=noise, plan=self._variant.plan)


def _speed(actions: FloatArray, displacements: bool) -> float:
    moved = actions[-1] if displacements else actions[-1] - actions[-2]
    return float(np.linalg.norm(moved[:3]))


@dataclass(frozen=True)
class Row:
    """One way to drive; evaluations are of one call, on average.

    Attributes:
        steps: evaluations that are steps of the loop.
        checks: those that look for where to begin.
        looking: milliseconds of these.
    """

    label: str
    steps: float
    checks: float
    looking: float
    evaluation: Evaluation

    def cells(self) -> list[str]:
        """For the table."""
        own = self.evaluation
        differences = ["" if one is None else str(one) for one in (own.score_difference, own.success_difference)]
        counts = [f"{one:.1f}" for one in (self.steps, self.checks, self.looking)]
        return [self.label, *counts, str(own.score), str(own.success), *differences]


def _several(read: Callable[[str], Any], example: str) -> Callable[..., tuple[Any, ...]]:
    """The callback of an option with commas between its values."""

    def parsed(_: click.Context, __: click.Parameter, value: str) -> tuple[Any, ...]:
        try:
            return tuple(read(word) for word in value.split(",") if word.strip())
        except ValueError as error:
            raise click.BadParameter(f"{error}; expected such as {example}.") from error

    return parsed


def _count(word: str) -> int:
    if (count := int(word)) < 1:
        raise ValueError(f"{count} is below 1")
    return count


def _beginning(word: str) -> tuple[float, int]:
    threshold, _, least = word.partition(":")
    return float(threshold), _count(least or "1")


@click.command()
@click.argument("variants", nargs=-1, required=True, metavar="DIR [DIR:PLAN...]")
@click.option(
    "--falcon",
    default="",
    callback=_several(_beginning, "0.02:8"),
    help="Begin where chunks differ by less; at least N steps.",
)
@click.option("--apart", is_flag=True, help="Look at Falcon's beginnings one after the other.")
@click.option("--light", default="", callback=_several(float, "4,8"), help="Leave out calls after faster actions.")
@click.option("--look", default="", callback=_several(_count, "2,3"), help="Look at the first of so many calls.")
@click.option("--displacements", is_flag=True, help="Actions say how far to move.")
@environment_option
@click.option("--episodes", default=96, show_default=True, type=click.IntRange(1))
@first_seed_option
@batch_option
@json_option
def main(
    variants: tuple[str, ...],
    falcon: tuple[tuple[float, int], ...],
    apart: bool,
    light: tuple[float, ...],
    look: tuple[int, ...],
    displacements: bool,
    environment: str,
    episodes: int,
    first_seed: int,
    batch: int,
    as_json: bool,
) -> None:
    """Drive every step of DIR, the rules on it, and other plans: DIR:NAME."""
    directory = Path(variants[0])
    plan = full_plan(directory)

    def opened() -> Variant:
        return open_variant(f"{directory}:{plan}", "onnxruntime", 1)

    whole = opened()
    counted: dict[str, Falcon | Light | Kept] = {}
    for threshold, least in falcon:
        counted[f"Falcon, {threshold:g}:{least}"] = Falcon(directory, plan, threshold, least, together=not apart)
    for fast in light:
        counted[f"SP-VLA, {fast:g}"] = Light(opened(), whole.policy.info.K, fast, displacements)
    for every in look:
        counted[f"a look in {every} calls"] = Kept(opened(), whole.policy.info.K, every)
    rules = [Variant(label, policy, None, whole.noise) for label, policy in counted.items()]
    driven = [whole, *(open_variant(text, "onnxruntime", 1) for text in variants[1:]), *rules]
    with Progress(console=Console(stderr=True)) as progress:
        tasks = {one.label: progress.add_task(one.label, total=episodes) for one in driven}
        found = evaluate(
            environment_class(environment),
            driven,
            range(first_seed, first_seed + episodes),
            batch,
            lambda label, done: progress.update(tasks[label], completed=done),
        )
    rows = [_row(variant, own, counted.get(variant.label)) for variant, own in zip(driven, found, strict=True)]
    if as_json:
        told = []
        for row in rows:
            counts = {"steps": row.steps, "checks": row.checks, "looking_ms": row.looking}
            told.append(counts | row.evaluation.to_json())
        click.echo(json.dumps(told))
        return
    table = Table(title=f"{environment}: {episodes} paired episodes; evaluations of the network in a call")
    for column in ("", "steps", "checks", "ms of them", "score", "success", "score, difference", "success, difference"):
        table.add_column(column, justify="right" if column else "left")
    for row in rows:
        table.add_row(*row.cells())
    results_console().print(table)


def _row(variant: Variant, own: Evaluation, rule: Falcon | Light | Kept | None) -> Row:
    if rule is None:
        return Row(variant.label, variant.policy.info.K * (1 - (own.sparsity or 0)), 0, 0, own)
    done = rule.count
    return Row(variant.label, done.steps / done.calls, done.checks / done.calls, 1e3 * done.looking / done.calls, own)


if __name__ == "__main__":
    run(main)
