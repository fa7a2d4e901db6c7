"""``ttscompile compare``: what accuracy costs, for strategies, the artifact's plans and other artifacts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ttscompile.calibration.strategies import NAMES
from ttscompile.cli.options import (
    artifact_argument,
    count_option,
    json_option,
    names_option,
    ray_option,
    seed_option,
    threads_option,
)
from ttscompile.cli.output import (
    counted_parts,
    manifest_of,
    only_results_on_stdout,
    print_json,
    progress,
    results,
    say,
    table,
)
from ttscompile.cli.recordings import FilesCommand, Sources, require_recordings, trajectories_options
from ttscompile.cli.types import PATH, PICTURE, TEXT, Number
from ttscompile.errors import ArtifactChangedError, RuntimeUnavailableError
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.measure.units import ms, share
from ttscompile.plots.frontier import plot_frontier

if TYPE_CHECKING:
    from rich.console import Console

    from ttscompile.measure.points import Comparison


def default_sparsities(steps: int) -> tuple[float, ...]:
    """Shares of the cells that a policy of ``steps`` steps can reuse, from safe to daring.

    Of less than 50 steps, what leaves five, three and two to compute: a single one is more than 0.98 leaves. Of two
    steps one can be left, and of a single one nothing.
    """
    if steps <= 2:
        return (0.5,) * (steps - 1)
    return (0.9, 0.95, 0.98) if steps >= 50 else tuple(1 - left / steps for left in (5, 3, 2) if left < steps)


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


@click.command(cls=FilesCommand)
@artifact_argument
@trajectories_options()
@names_option(
    "--strategies",
    NAMES,
    default="tts,bac,interval",
    help="Each finds a plan for each sparsity; an empty list compares plans of artifacts alone.",
)
@click.option(
    "--sparsities",
    type=TEXT,
    callback=_sparsities,
    help="For strategies; 0.9,0.95,0.98 if not given, or, of less than 50 steps, what leaves five, three and two.",
)
@click.option(
    "--with",
    "others",
    multiple=True,
    type=PATH,
    metavar="DIR...",
    help="Other artifacts of the same checkpoint, for instance with other samplers; every word up to the next option.",
)
@count_option("--calls", "Held-out calls, at most.", default=32)
@count_option("--learned-calls", "To learn from, at most.", default=256, least=2)
@threads_option("Of onnxruntime.")
@click.option(
    "--max-minutes",
    type=Number(0, 1e6),
    default=3.0,
    show_default=True,
    help="Limit of each search, about; there is one for each strategy and sparsity.",
)
@click.option(
    "--correct",
    is_flag=True,
    help="Let plans of strategies that fit no correction take part a second time, with one that is fitted to them.",
)
@count_option("--intervals", "Of each search, at most; for a quick look.", default=None)
@seed_option("Of the split, the noise and the searches.")
@ray_option
@click.option("--resume", is_flag=True, help="Go on after the searches that an interrupted comparison had done.")
@click.option("--plot", "picture", type=PICTURE, help="Draw into this file (.png, .svg, .pdf).")
@json_option
def compare(
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    strategies: tuple[str, ...],
    sparsities: tuple[float, ...] | None,
    others: tuple[Path, ...],
    learned_calls: int,
    picture: Path | None,
    as_json: bool,
    **search: Any,  # the comparison of ttscompile.calibration takes them by the same names
) -> None:
    """Hold plans of the artifact DIRECTORY against each other: held-out action error and measured latency.

    Strategies find plans now, from the episodes that are not held out. Until the end, what they found is kept in a file
    beside the artifact's own, for --resume; nothing else is written there. Every plan
    runs on the same calls, in turn, and its actions are held against those of the dense policy with the same noise.
    """
    manifests = {path: manifest_of(path) for path in (directory, *others)}  # of what is measured now
    require_recordings(trajectories)
    try:
        from ttscompile.calibration.compare import compare as measure
    except ModuleNotFoundError as error:
        raise RuntimeUnavailableError(
            f"compare needs {error.name}, which is not installed. Run: pip install 'ttscompile[compile]'."
        ) from error
    if sparsities is None:
        sparsities = default_sparsities(manifests[directory].steps)
    with only_results_on_stdout(), counted_parts() as tell:
        found = measure(
            directory,
            trajectories,
            strategies,
            sparsities if strategies else (),
            others,
            observation=sources,
            learned=learned_calls,
            progress=tell,
            **search,
        )
    if any(manifest_of(path).identity != manifest.identity for path, manifest in manifests.items()):
        raise ArtifactChangedError(f"{directory}: it, or another that was compared, was replaced meanwhile. Try again.")
    told = progress()
    say(told, *(f"warning: {warning}" for warning in found.warnings))
    machine, threads = fingerprint(), f"{found.threads} thread{'s' * (found.threads > 1)}"
    if as_json:
        compared = [{"path": str(path), "identity": manifests[path].identity} for path in others]
        identity = manifests[directory].identity
        print_json({"identity": identity, "with": compared, "machine": machine, **found.to_json()})
    else:
        output = results()
        _print(found, output, threads)
        say(output, one_line(machine))
        say(output, *(f"{path}: identity {manifest.short_identity}" for path, manifest in manifests.items()))
    if picture is not None:
        title = f"{directory.resolve().name}: {found.calls} held-out calls, {threads}\n{one_line(machine)}"
        plot_frontier(found.points, found.efficient(), found.yardsticks, picture, title)
        say(told, f"wrote {picture}")


def _print(found: Comparison, output: Console, threads: str) -> None:
    """The comparison as a table, and what is compared."""
    efficient = found.efficient()
    made = table("", "plan", "error", "90th pct.", "ms a call", "quartiles", "GFLOP", "reused", "frontier")
    for p in found.points:
        made.add_row(
            p.series,
            p.name + " *" * (p.noise != "all"),
            f"{p.error:.4g}",
            f"{p.error_p90:.4g}",
            ms(p.latency_ms, 4),
            "..".join(ms(quartile, 4) for quartile in p.quartiles_ms),
            f"{p.flops / 1e9:.3f}",
            share(p.sparsity),
            "yes" if p in efficient else "",
        )
    output.print(made)
    say(
        output,
        f"Error: mean absolute difference of the executed actions, in their units, from those of the dense policy in"
        f" fp32 with the same observation and noise; {found.calls} calls of episodes that no strategy here learned"
        f" from, each as the first of its episode. Latency: medians of the same calls, one stream, {threads}."
        " Comparison: no other plan is faster and more accurate.",
    )
    told = {"steps": "the same initial sample and other draws", "all": "other noise altogether"}
    apart = "; ".join(f"by {error:.4g} with {told[name]}" for name, error in found.yardsticks.items())
    if any(p.noise != "all" for p in found.points):
        say(
            output,
            "* Another sampler: it shares the initial sample with the dense policy and nothing else (and a stochastic"
            " sampler soon forgets that), so its error holds what other noise would change too. Compare it with the"
            " yardstick, and judge it by the task's score.",
        )
    say(output, f"Yardstick: two dense calls are apart {apart}.")
    say(output, *(f"{name}: left out: {reason}" for name, reason in found.skipped.items()))
