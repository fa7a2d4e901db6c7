"""Distance from the original against latency, as ``bench -t`` and the script of the strategies show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ttscompile.artifact.load import Artifact
from ttscompile.calibration.progress import Bar
from ttscompile.cli.output import manifest_of, only_results_on_stdout, progress, say, table
from ttscompile.errors import ArtifactChangedError, needing
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.measure.units import ms, share
from ttscompile.plots.figure import write_picture
from ttscompile.plots.frontier import plot_calls, plot_frontier

if TYPE_CHECKING:
    from rich.console import Console

    from ttscompile.measure.points import Comparison


def compare(
    directory: Path, artifacts: Mapping[str, Artifact], others: Sequence[Path], trajectories: Sequence[Path], **how: Any
) -> Comparison:
    """Hold plans against the dense policy on held-out calls, as ``calibration.compare``; warns on standard error.

    Raises:
        ArtifactChangedError: an artifact was replaced meanwhile.
        RuntimeUnavailableError: there is no torch.
    """
    with needing("-t", "compile"):
        from ttscompile.calibration.compare import compare as measure
    with only_results_on_stdout(), Bar(shown=True) as bar:
        found = measure(directory, trajectories, others, progress=bar.tell, **how)
    pairs = zip((directory, *others), artifacts.values(), strict=True)
    if changed := [path for path, one in pairs if manifest_of(path).identity != one.manifest.identity]:
        raise ArtifactChangedError(f"{changed[0]}: it was replaced meanwhile. Try again.")
    say(progress(), *(f"warning: {warning}" for warning in found.warnings))
    return found


def draw_comparison(found: Comparison, directory: Path, picture: Path) -> str:
    """Draw it, and beside it the calls that are furthest from the original; says so."""
    title = f"{directory.resolve().name}: {found.calls} held-out calls, {_threads(found)}\n{one_line(fingerprint())}"
    write_picture(plot_frontier(found.points, found.efficient(), title), picture)
    write_picture(plot_calls(found.points[1:] or found.points), calls := picture.with_stem(f"{picture.stem}-calls"))
    return f"wrote {picture} and {calls}"


def _threads(found: Comparison) -> str:
    return f"{found.threads} thread{'s' * (found.threads > 1)}"


def print_comparison(found: Comparison, output: Console) -> None:
    """The comparison as a table, and what is compared."""
    efficient = found.efficient()
    scored = ("", "plan", "distance", "95 %", "error", "90th pct.")
    made = table(*scored, "ms a call", "quartiles", "GFLOP", "reused", "frontier")
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
    apart = table("", "plan", "distance by number of the action", "error", "furthest calls")
    for p in found.points:
        calls = (f"episode {one.episode}, call {one.call}: {one.distance:.2f}" for one in p.furthest)
        numbers = (", ".join(f"{one:.3g}" for one in each) for each in (p.by_number, p.errors))
        apart.add_row(p.series, p.name, *numbers, "; ".join(calls))
    output.print(apart)
    say(
        output,
        "Distance: between the actions and the original's for the same observation, in units of what other noise"
        f" changes; 0 is the same. {found.calls} observations of episodes that no strategy here learned from, each with"
        " several draws of noise. Error: with the same noise, in the units of the actions, in which two calls of the"
        f" original are {found.other_noise:.4g} apart; another sampler takes other noise, and has none. Latency:"
        f" medians, one stream, {_threads(found)}. Frontier: no other plan is faster and nearer.",
    )
    say(output, *(f"{name}: left out: {reason}" for name, reason in found.skipped.items()))
