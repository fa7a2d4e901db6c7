"""``ttscompile compare``: what accuracy costs, for strategies, the artifact's plans and other artifacts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ttscompile.artifact.manifest import abbreviated
from ttscompile.calibration.strategies import NAMES
from ttscompile.cli.output import (
    artifact_argument,
    identity_of,
    json_option,
    manifest_of,
    ms,
    only_results_on_stdout,
    print_json,
    progress,
    results,
    share,
    table,
)
from ttscompile.cli.recordings import FilesCommand, Sources, require_recordings, trajectories_options
from ttscompile.errors import RuntimeUnavailableError
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.plots.frontier import plot_frontier

if TYPE_CHECKING:
    from rich.console import Console

    from ttscompile.measure.points import Frontier


def _strategies(_: click.Context, __: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in value.split(",") if name.strip()))
    unknown = [name for name in names if name not in NAMES]
    if unknown:
        raise click.BadParameter(f"{unknown[0]!r} is not one of {', '.join(NAMES)}.")
    return names


SPARSITIES = 0.9, 0.95, 0.98
LEFT = 5, 3, 2
"""Steps to compute in their place, where a call has so few that one of them is more than the last leaves."""


def default_sparsities(steps: int) -> tuple[float, ...]:
    """Shares of the cells that a policy of ``steps`` steps can reuse, from safe to daring."""
    return SPARSITIES if steps >= 50 else tuple(1 - left / steps for left in LEFT if left < steps)


def _sparsities(_: click.Context, __: click.Parameter, value: str | None) -> tuple[float, ...] | None:
    if value is None:
        return None
    try:
        found = tuple(dict.fromkeys(float(part) for part in value.split(",") if part.strip()))
    except ValueError as error:
        raise click.BadParameter(f"{error}; expected numbers, such as 0.9,0.95.") from error
    wrong = [one for one in found if not 0 < one < 1]
    if wrong:
        raise click.BadParameter(f"{wrong[0]:g} is not above 0 and below 1.")
    return found


@click.command(cls=FilesCommand)
@artifact_argument
@trajectories_options()
@click.option(
    "--strategies",
    default="tts,bac,interval",
    show_default=True,
    callback=_strategies,
    help="Each finds a plan for each sparsity; an empty list compares plans of artifacts alone.",
)
@click.option(
    "--sparsities",
    callback=_sparsities,
    help="For strategies; 0.9,0.95,0.98 if not given, or, of less than 50 steps, what leaves five, three and two.",
)
@click.option(
    "--with",
    "others",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="DIR...",
    help="Other artifacts of the same checkpoint, for instance with other samplers; every word up to the next option.",
)
@click.option("--calls", type=click.IntRange(min=1), default=32, show_default=True, help="Held-out calls, at most.")
@click.option(
    "--learned-calls", type=click.IntRange(min=2), default=256, show_default=True, help="To learn from, at most."
)
@click.option("--threads", type=click.IntRange(min=1), default=1, show_default=True, help="Of onnxruntime.")
@click.option(
    "--max-minutes",
    type=click.FloatRange(min=0),
    default=3.0,
    show_default=True,
    help="Limit of each search, about; there is one for each strategy and sparsity.",
)
@click.option("--intervals", type=click.IntRange(min=1), help="Of each search, at most; for a quick look.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the split, the noise and the searches."
)
@click.option("--plot", "picture", type=click.Path(path_type=Path), help="Draw into this file (.png, .svg, .pdf).")
@json_option
def compare(
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    strategies: tuple[str, ...],
    sparsities: tuple[float, ...] | None,
    others: tuple[Path, ...],
    calls: int,
    learned_calls: int,
    threads: int,
    max_minutes: float,
    intervals: int | None,
    seed: int,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Hold plans of the artifact DIRECTORY against each other: held-out action error and measured latency.

    Strategies find plans now, from the episodes that are not held out; nothing is written to the artifact. Every plan
    runs on the same calls, in turn, and its actions are held against those of the dense policy with the same noise.
    """
    identities = {path: identity_of(path) for path in (directory, *others)}  # of what is measured now
    require_recordings(trajectories)
    try:
        from ttscompile.calibration.compare import compare as measure
    except ModuleNotFoundError as error:
        raise RuntimeUnavailableError(
            f"compare needs {error.name}, which is not installed. Run: pip install 'ttscompile[compile]'."
        ) from error
    if sparsities is None:
        sparsities = default_sparsities(manifest_of(directory).steps)
    columns = (TextColumn("{task.description:<28}"), BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn())
    told = progress()
    with only_results_on_stdout(), Progress(*columns, console=told, disable=not told.is_terminal) as bar:
        task = bar.add_task("loading", total=None)

        def tell(what: str, done: int, total: int) -> None:
            if not told.is_terminal and what != bar.tasks[task].description:  # a log has no bar
                told.print(what, soft_wrap=True)
            bar.update(task, description=what, completed=done, total=total)

        found = measure(
            directory,
            trajectories,
            strategies,
            sparsities if strategies else (),
            others,
            observation=sources,
            calls=calls,
            learned=learned_calls,
            threads=threads,
            seed=seed,
            intervals=intervals,
            max_minutes=max_minutes,
            progress=tell,
        )
    for warning in found.warnings:
        told.print(f"warning: {warning}", soft_wrap=True)
    machine = one_line(fingerprint())
    if as_json:
        compared = [{"path": str(path), "identity": identities[path]} for path in others]
        print_json({"identity": identities[directory], "with": compared, "machine": fingerprint(), **found.to_json()})
    else:
        _print(found, results(), machine)
        for path, identity in identities.items():
            results().print(f"{path}: identity {abbreviated(identity)}", soft_wrap=True)
    if picture is not None:
        name = directory.resolve().name
        title = f"{name}: {found.calls} held-out calls, {threads} thread{'s' * (threads > 1)}\n{machine}"
        plot_frontier(found.points, found.efficient(), found.yardsticks, picture, title)
        told.print(f"wrote {picture}", soft_wrap=True)


def _print(found: Frontier, output: Console, machine: str) -> None:
    """The comparison as a table, and what is compared."""
    efficient = found.efficient()
    made = table("", "plan", "error", "90th pct.", "ms a call", "quartiles", "GFLOP", "reused", "frontier")
    for p in found.points:
        low, high = p.quartiles_ms
        made.add_row(
            p.series,
            p.name + " *" * (p.noise != "all"),
            f"{p.error:.4g}",
            f"{p.error_p90:.4g}",
            ms(p.latency_ms, 4),
            f"{ms(low, 4)}..{ms(high, 4)}",
            f"{p.flops / 1e9:.3f}",
            share(p.sparsity),
            "yes" if p in efficient else "",
        )
    output.print(made)
    output.print(
        f"Error: mean absolute difference of the executed actions, in their units, from those of the dense policy in"
        f" fp32 with the same observation and noise; {found.calls} calls of episodes that no strategy here learned"
        f" from. Latency: medians of the same calls, one stream, {found.threads} thread{'s' * (found.threads > 1)}."
        " Frontier: no other plan is faster and more accurate.",
        soft_wrap=True,
    )
    told = {"steps": "the same initial sample and other draws", "all": "other noise altogether"}
    apart = "; ".join(f"by {error:.4g} with {told[name]}" for name, error in found.yardsticks.items())
    if any(p.noise != "all" for p in found.points):
        output.print(
            "* Another sampler: it shares the initial sample with the dense policy and nothing else (and a stochastic"
            " sampler soon forgets that), so its error holds what other noise would change too. Compare it with the"
            " yardstick, and judge it by the task's score.",
            soft_wrap=True,
        )
    output.print(f"Yardstick: two dense calls are apart {apart}.", soft_wrap=True)
    for name, reason in found.skipped.items():
        output.print(f"{name}: left out: {reason}", soft_wrap=True)
    output.print(machine, soft_wrap=True)
