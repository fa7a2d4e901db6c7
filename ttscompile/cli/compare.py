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
    """Hold plans of the artifact DIRECTORY against each other: how far from the original, and how fast.

    Strategies find plans now, from the episodes that are not held out. Until the end, what they found is kept in a file
    beside the artifact's own, for --resume; nothing else is written there. Every plan
    runs on the same calls; how far its actions are from the original's is what 'calibrate' goes by, too.
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
        plot_frontier([p.point for p in found.points], [p.point for p in found.efficient()], picture, title)
        say(told, f"wrote {picture}")


def _print(found: Comparison, output: Console, threads: str) -> None:
    """The comparison as a table, and what is compared."""
    efficient = found.efficient()
    head = (
        "",
        "plan",
        "distance",
        "95 %",
        "error",
        "90th pct.",
        "ms a call",
        "quartiles",
        "GFLOP",
        "reused",
        "frontier",
    )
    made = table(*head)
    for p in found.points:
        made.add_row(
            p.series,
            p.name,
            f"{p.distance:.3f}",
            "..".join(f"{one:.3f}" for one in p.interval),
            "" if p.error is None else f"{p.error:.4g}",
            "" if p.error_p90 is None else f"{p.error_p90:.4g}",
            ms(p.latency_ms, 4),
            "..".join(ms(quartile, 4) for quartile in p.quartiles_ms),
            f"{p.flops / 1e9:.3f}",
            share(p.sparsity),
            "yes" if p in efficient else "",
        )
    output.print(made)
    say(
        output,
        f"Distance: between the actions and the original's for the same observation, in units of what other noise"
        f" changes; 0 is the same. {found.calls} observations of episodes that no strategy here learned from, each with"
        f" several draws of noise. Error: with the same noise, in the units of the actions, in which two calls of the"
        f" original are {found.other_noise:.4g} apart; another sampler takes other noise, and has none. Latency:"
        f" medians, one stream, {threads}. Frontier: no other plan is faster and nearer.",
    )
    say(output, *(f"{name}: left out: {reason}" for name, reason in found.skipped.items()))
