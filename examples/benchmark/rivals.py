"""What accuracy costs with rivals: each finds a plan for each share of reused cells, or each time, now.

    python examples/benchmark/rivals.py compiled/ -t calls.npz --learn schedule,bac,interval --plot frontier.png

With ``--latency-ms`` or ``--even-steps`` each gets the largest budget, in its own cells, whose plan keeps the time
(``equal_time.py``): plans of as many cells do not take equally long.

Their plans take part beside those of the artifact, and of other artifacts, in what ``ttscompile bench -t`` measures:
held-out action error and latency. Until the end, what searches found is kept in a file beside the artifact's own, for
``--resume``; nothing else is written there. ``--into`` writes the plans into a copy, so that they can be driven.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import click
from commands import numbers
from equal_time import Pace, pace_of
from searches import LEARNED, Searching

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import require_replaceable, update_plans
from ttscompile.calibration.proposers import SCHEDULES
from ttscompile.calibration.trials import Trials
from ttscompile.cli.contestants import compare, draw_comparison, print_comparison
from ttscompile.cli.options import (
    MOST_SEED,
    artifact_argument,
    count_option,
    json_option,
    names_option,
    ray_option,
    threads_option,
)
from ttscompile.cli.output import print_json, progress, results, run, say
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options
from ttscompile.cli.types import PATH, PICTURE, TEXT, Number
from ttscompile.measure.machine import fingerprint, one_line


def default_sparsities(steps: int) -> tuple[float, ...]:
    """Shares of the cells that a policy of ``steps`` steps can reuse, from safe to daring.

    Of less than 50 steps, what leaves five, three and two to compute: a single one is more than 0.98 leaves. Of two
    steps one can be left, and of a single one nothing.
    """
    if steps <= 2:
        return (0.5,) * (steps - 1)
    return (0.9, 0.95, 0.98) if steps >= 50 else tuple(1 - left / steps for left in (5, 3, 2) if left < steps)


def _milliseconds(_: click.Context, __: click.Parameter, value: str | None) -> tuple[float, ...]:
    try:
        found = tuple(float(part) for part in (value or "").split(",") if part.strip())
    except ValueError as error:
        raise click.BadParameter(f"{error}; expected milliseconds, such as 20,40.") from error
    return found


def _sparsities(_: click.Context, __: click.Parameter, value: str | None) -> tuple[float, ...] | None:
    if value is None:
        return None
    try:
        found = tuple(dict.fromkeys(float(part) for part in value.split(",") if part.strip()))
    except ValueError as error:
        raise click.BadParameter(f"{error}; expected numbers, such as 0.9,0.95.") from error
    if wrong := [one for one in found if not 0 < one < 1]:
        raise click.BadParameter(f"{wrong[0]:g} is not above 0 and below 1.")
    return found


@click.command(cls=SectionedCommand)
@artifact_argument
@trajectories_options()
@names_option(
    "--learn",
    [row.name for row in SCHEDULES],
    default="schedule,bac,interval",
    help="Have each of these propose schedules.",
)
@click.option(
    "--sparsities",
    type=TEXT,
    callback=_sparsities,
    help="Find a plan for each of these shares of reused cells; 0.9,0.95,0.98 if not given, or, of less than 50 steps,"
    " what leaves five, three and two.",
)
@click.option(
    "--latency-ms",
    type=TEXT,
    callback=_milliseconds,
    help="In place of sparsities: give each the most cells with which its calls take so many milliseconds.",
)
@click.option(
    "--even-steps",
    type=TEXT,
    callback=numbers,
    help="The same, and the time is what so many evenly spaced whole steps take, in turn with each plan.",
)
@click.option(
    "--with", "others", multiple=True, type=PATH, metavar="DIR...", help="Let these artifacts take part, too."
)
@count_option("--calls", "Judge on so many held-out calls, at most.", default=32)
@count_option("--learned-calls", "Learn from so many calls, at most.", default=LEARNED, least=2)
@threads_option("Threads that onnxruntime computes with.")
@click.option(
    "--max-minutes",
    type=Number(0, 1e6),
    default=3.0,
    show_default=True,
    help="End each search after so many minutes, about; there is one for each proposer and sparsity.",
)
@click.option(
    "--correct",
    is_flag=True,
    help="Let plans of those that fit no correction take part a second time, with one that is fitted to them.",
)
@count_option("--intervals", "End each search after so many intervals; for a quick look.", default=None)
@count_option("--seed", "Seed of the split, the noise and the searches.", default=0, least=0, most=MOST_SEED)
@ray_option
@click.option("--resume", is_flag=True, help="Go on after the searches that an interrupted run had done.")
@click.option(
    "--into",
    type=PATH,
    metavar="DIR",
    help="Write a copy of the artifact with the plans that were found: bac-0.95, bac-corrected-0.95 and so on.",
)
@click.option("--plot", "picture", type=PICTURE, help="Draw into this file (.png, .svg, .pdf).")
@json_option
def main(
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    learn: tuple[str, ...],
    sparsities: tuple[float, ...] | None,
    latency_ms: tuple[float, ...],
    even_steps: tuple[int, ...] | None,
    others: tuple[Path, ...],
    calls: int,
    learned_calls: int,
    threads: int,
    seed: int,
    into: Path | None,
    picture: Path | None,
    as_json: bool,
    **search: Any,  # Searching takes them by the same names
) -> None:
    """Hold plans that proposers of schedules find now against those of the artifact DIRECTORY."""
    if into is not None:
        require_replaceable(into)
        if into.resolve() in [path.resolve() for path in (directory, *others)]:
            raise click.BadParameter(f"{into} takes part. Give another folder for the plans that are found.")
    artifacts = {str(path): load_artifact(path) for path in (directory, *others)}
    of = artifacts[str(directory)].manifest
    timed = bool(latency_ms or even_steps)
    if timed and sparsities:
        raise click.BadParameter("give either sparsities or a time.")
    if wrong := [count for count in even_steps or () if count >= of.steps]:
        raise click.BadParameter(f"{wrong[0]} of {of.steps} steps are all there are.")

    def paces(trials: Trials) -> list[Pace]:
        given = [pace_of(trials, one, threads) for one in latency_ms]
        return given + [Pace(trials, count, threads, f"as-{count}") for count in even_steps or ()]

    wished = () if timed or not learn else sparsities or default_sparsities(of.steps)
    joining = Searching(directory, learn, wished, learned=learned_calls, paces=paces if timed else None, **search)
    how: dict[str, Any] = {"observation": sources, "calls": calls, "threads": threads, "seed": seed}
    found = compare(directory, artifacts, others, trajectories, joining=joining, **how)
    if as_json:
        compared = [{"path": str(path), "identity": artifacts[str(path)].manifest.identity} for path in others]
        about = {"identity": of.identity, "with": compared, "machine": fingerprint()}
        print_json({**about, "comparison": found.to_json(), "shares": joining.shares})
    else:
        output = results()
        print_comparison(found, output)
        say(output, one_line(fingerprint()))
        say(output, *(f"{path}: identity {one.manifest.short_identity}" for path, one in artifacts.items()))
    if picture is not None:
        say(progress(), draw_comparison(found, directory, picture))
    if into is not None and joining.plans:
        shutil.rmtree(into, ignore_errors=True)
        shutil.copytree(directory, into)
        update_plans(into, {**artifacts[str(directory)].plans, **joining.plans}, next(iter(joining.plans)))
    elif into is not None:
        say(progress(), f"warning: no plan was found, so {into} was not written.")
    joining.forget()  # last, so that --resume goes on after what failed before


if __name__ == "__main__":
    run(main)
