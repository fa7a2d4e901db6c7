"""How far from the original are plans where an observation is unlike all that was recorded?

    python examples/evaluation/departures.py DIR --trajectories calls.npz
    python examples/evaluation/record.py DIR -o wandered.npz --wander
    python examples/evaluation/departures.py DIR --trajectories calls.npz --other wandered.npz --summary

Every departure changes recorded observations, and the plans of an artifact answer what comes of them. Each is compared
with the plan that computes every cell, with the same noise, in units of what other noise changes in what was recorded.
Beside a plan stands what it would be if nobody looked how far outside a call is, and even steps without a correction.
Images and instructions stay as they are. With --summary there is one row a plan, with what is worst of its departures.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
from rich.table import Table
from variants import full_plan, json_option, results_console, run

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.core.envelope import FAR, plain_cells
from ttscompile.core.plan import Plan
from ttscompile.core.spec import FloatArray, Noise, ObservationSpec
from ttscompile.runtimes import Runtime, open_runtime
from ttscompile.trajectories import load_trajectories

BATCH = 32
"""Calls that are computed together."""
ALLOWED = 0.1
"""Of other noise: how much further than even steps a plan may be."""

Observation = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Distances:
    """Of one plan under one departure, in units of other noise.

    Attributes:
        departure: what was changed.
        plan: name of the plan.
        outside: share of the calls that are so far outside that they have no correction.
        distance: mean over the calls.
        unbounded: the same if nobody looked how far outside a call is.
        even: of as many steps, evenly spaced, without a correction.
    """

    departure: str
    plan: str
    outside: float
    distance: float
    unbounded: float
    even: float


@dataclass(frozen=True)
class Recorded:
    """The values of one key, ``[n, ..., Do]``, and their range, number by number."""

    values: FloatArray

    @cached_property
    def low(self) -> FloatArray:
        """The lowest of each number, ``[Do]``."""
        return np.asarray(self.values.min(tuple(range(self.values.ndim - 1))))

    @cached_property
    def high(self) -> FloatArray:
        """The highest of each number, ``[Do]``."""
        return np.asarray(self.values.max(tuple(range(self.values.ndim - 1))))

    @property
    def middle(self) -> FloatArray:
        """Of the range of each number, ``[Do]``."""
        return np.asarray((self.low + self.high) / 2, np.float32)

    @property
    def some_numbers(self) -> range:
        """Three or four of the Do, evenly spaced; all where there are fewer."""
        count = self.values.shape[-1]
        return range(0, count, max(1, count // 3))

    def noisy(self, rng: np.random.Generator) -> FloatArray:
        """With noise of 1 % of the range."""
        noise = rng.standard_normal(self.values.shape, np.float32)
        return self.values + np.float32(0.01) * (self.high - self.low) * noise

    def drawn(self, rng: np.random.Generator) -> FloatArray:
        """At random in the range."""
        return rng.uniform(self.low, self.high, self.values.shape).astype(np.float32)

    def stretched(self, times: float) -> FloatArray:
        """So many times as far from the middle."""
        return self.middle + times * (self.values - self.middle)

    def mirrored(self, number: int) -> FloatArray:
        """With this number on the other side of its middle; as they are where there is no such number."""
        changed = self.values.copy()
        if number < changed.shape[-1]:
            changed[..., number] = 2 * self.middle[number] - changed[..., number]
        return changed


def departures(
    values: Mapping[str, FloatArray], rng: np.random.Generator, other: Mapping[str, FloatArray] | None = None
) -> Iterator[tuple[str, dict[str, FloatArray]]]:
    """What can be done to observations, all keys at once: its name, and what comes of it.

    Args:
        values: recorded, by key, ``[n, ..., Do]``; each may have a Do of its own.
        rng: of what is random.
        other: the same keys, recorded while something else was done.
    """
    every = {key: Recorded(each) for key, each in values.items()}

    def changed(how: Callable[[Recorded], FloatArray]) -> dict[str, FloatArray]:
        return {key: how(each) for key, each in every.items()}

    yield "as recorded", dict(values)
    yield "noise of 1 % of the range", changed(lambda one: one.noisy(rng))
    for times in (1.2, 3, 4, 6, 10, 30):
        yield f"{times:g} times the range", changed(partial(Recorded.stretched, times=times))
    for number in sorted({number for each in every.values() for number in each.some_numbers}):
        yield f"number {number} mirrored", changed(partial(Recorded.mirrored, number=number))
    yield "constant: lowest", changed(lambda one: np.broadcast_to(one.low, one.values.shape))
    yield "constant: highest", changed(lambda one: np.broadcast_to(one.high, one.values.shape))
    yield "constant: zeros", changed(lambda one: np.zeros_like(one.values))
    yield "random in the range", changed(lambda one: one.drawn(rng))
    yield "columns reversed", changed(lambda one: one.values[..., ::-1])
    yield "times 100", changed(lambda one: 100 * one.values)
    if other is not None:
        yield "another task", {key: other[key] for key in values}


class Calls:
    """The same calls of several plans.

    Args:
        artifact: whose plans they are.
        count: of calls.
        seed: of their noise.
    """

    def __init__(self, artifact: Artifact, count: int, seed: int) -> None:
        self._spec = artifact.manifest.spec
        rng, shape = np.random.default_rng(seed), (count, *self._spec.sample)
        self._initial = rng.standard_normal(shape, dtype=np.float32)
        self._seed = seed

    def answers(self, runtime: Runtime, plan: Plan, observation: Observation) -> tuple[FloatArray, list[float]]:
        """Executed actions, normalised, ``[n, A]``, and how far outside each call is."""
        made, outside = [], list[float]()
        for start in range(0, len(self._initial), BATCH):
            part, rng = slice(start, start + BATCH), np.random.default_rng((self._seed, start))
            initial = self._initial[part]
            sampler = runtime.view(plan).manifest.spec.sampler
            steps = rng.standard_normal((sampler.steps, *initial.shape), dtype=np.float32)
            noise = Noise(initial, steps if sampler.stochastic else None)
            runtime.reset()
            given = {key: self._spec.observations[key].normalized(value[part]) for key, value in observation.items()}
            sample, report = runtime.predict(given, noise, plan)
            chunk = self._spec.chunk
            made.append(sample[:, chunk.start : chunk.stop, : chunk.action_dim].reshape(len(initial), -1))
            outside += report.outside
        return np.concatenate(made), outside


def apart(one: FloatArray, other: FloatArray) -> float:
    """Root mean square difference, mean over the calls."""
    return float(np.sqrt(np.square(one - other, dtype=np.float64).mean(1)).mean())


def measured(
    artifact: Artifact, names: Sequence[str], recorded: Observation, other_task: Observation | None
) -> Iterator[Distances]:
    """Distances of plans from the one that computes everything; of another task there are as many calls as recorded."""
    full = artifact.plan(full_plan(artifact.path))
    runtime, unbounded = (open_runtime(one, plan=full) for one in (artifact, replace(artifact, envelope=None)))
    count, rng = rows(recorded), np.random.default_rng(0)
    calls, with_other_noise = (Calls(artifact, count, seed) for seed in (0, 1))
    noise_changes = apart(*(one.answers(runtime, full, recorded)[0] for one in (calls, with_other_noise)))
    blocks = len(artifact.manifest.groups)
    vectors = {key: value for key, value in recorded.items() if vector(artifact.manifest.spec.observations[key])}
    for departure, changed in departures(vectors, rng, other_task):
        observation = recorded | {key: np.ascontiguousarray(value, np.float32) for key, value in changed.items()}
        exact, _ = calls.answers(runtime, full, observation)
        for name in names:
            plan = artifact.plan(name)
            assert plan.correction is not None
            even = replace(plan, cells=plain_cells(plan.correction, blocks), correction=None)
            own, outside = calls.answers(runtime, plan, observation)
            others = (calls.answers(unbounded, one, observation)[0] for one in (plan, even))
            far = float(np.mean(np.array(outside) > FAR)) if outside else 0.0
            yield Distances(departure, name, far, *(apart(each, exact) / noise_changes for each in (own, *others)))


def vector(spec: ObservationSpec) -> bool:
    """Whether it is a vector of floats, which can stray."""
    return np.dtype(spec.dtype).kind == "f" and not spec.image


@click.command()
@click.argument("directory", type=click.Path(path_type=Path))
@click.option("-t", "--trajectories", multiple=True, required=True, type=click.Path(path_type=Path))
@click.option("--plan", "names", multiple=True, help="Plans; without it all that have a correction.")
@click.option("--other", multiple=True, type=click.Path(path_type=Path), help="Recorded while something else was done.")
@click.option("--summary", is_flag=True, help="One row a plan.")
@click.option("--calls", default=64, show_default=True, help="Recorded calls.")
@json_option
def main(
    directory: Path,
    trajectories: tuple[Path, ...],
    names: tuple[str, ...],
    other: tuple[Path, ...],
    summary: bool,
    calls: int,
    as_json: bool,
) -> None:
    """Compare plans of the artifact DIRECTORY with the original where nothing was recorded.

    Exit status 1: a plan is further from the original than even steps by more than a tenth of other noise.
    """
    artifact = load_artifact(directory)
    recorded = some_calls(artifact, trajectories, calls)
    others = some_calls(artifact, other, calls) if other else None
    count = min(rows(each) for each in (recorded, others) if each is not None)
    recorded = {key: value[:count] for key, value in recorded.items()}
    others = others and {key: value[:count] for key, value in others.items()}
    found = list(measured(artifact, with_correction(artifact, names), recorded, others))
    show(found, summary, as_json)
    worst = max(found, key=lambda one: one.distance - one.even)
    if worst.distance - worst.even > ALLOWED:
        further = f"{worst.distance - worst.even:.2f} of other noise further from the original than even steps are"
        click.echo(f"plan '{worst.plan}' is {further}, at: {worst.departure}", err=True)
        raise SystemExit(1)


def with_correction(artifact: Artifact, names: Sequence[str]) -> list[str]:
    """The plans that were asked for, or all that have a correction.

    Raises:
        click.UsageError: there is none, or one that was asked for has none.
    """
    corrected = [name for name, plan in artifact.plans.items() if plan.correction is not None]
    plain = [name for name in names if artifact.plan(name).correction is None]
    if plain or not corrected:
        found = f"plan '{plain[0]}' has none" if plain else "no plan has one"
        there = f"Plans that have one: {', '.join(corrected)}" if corrected else "'ttscompile build' makes such plans"
        raise click.UsageError(f"{artifact.path}: expected plans with a correction; found that {found}. {there}.")
    return list(names) or corrected


def rows(observation: Observation) -> int:
    """How many calls there are."""
    return len(next(iter(observation.values())))


def some_calls(artifact: Artifact, paths: Sequence[Path], calls: int) -> Observation:
    """So many calls of recordings, drawn at random."""
    spec = artifact.manifest.spec
    episodes = load_trajectories(paths, spec.observations, spec.chunk.stop - spec.chunk.start)
    every = {key: np.concatenate([one.observations[key] for one in episodes]) for key in spec.observations}
    chosen = np.random.default_rng(0).permutation(len(next(iter(every.values()))))[:calls]
    return {key: value[chosen] for key, value in every.items()}


def show(found: Sequence[Distances], summary: bool, as_json: bool) -> None:
    """Print them all, or what is worst of each plan."""
    if as_json:
        print(json.dumps([asdict(one) for one in found]))
        return
    if summary:
        table = Table("plan", "as recorded", "even steps", "worst, beside even steps", "at", box=None)
        for name in dict.fromkeys(one.plan for one in found):
            own = [one for one in found if one.plan == name]
            worst = max(own, key=lambda one: one.distance - one.even)
            shown = own[0].distance, own[0].even, worst.distance - worst.even
            table.add_row(name, *(f"{each:.2f}" for each in shown), worst.departure)
        results_console().print(table)
        return
    table = Table("departure", "plan", "without correction", "distance", "if nobody looked", "even steps", box=None)
    for one in found:
        told = (f"{each:.2f}" for each in (one.distance, one.unbounded, one.even))
        table.add_row(one.departure, one.plan, f"{one.outside:.0%}", *told)
    results_console().print(table)


if __name__ == "__main__":
    run(main)
