"""Action error against latency, as ``bench -t`` and the script of the strategies show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ttscompile.artifact.load import Artifact
from ttscompile.cli.output import counted_parts, manifest_of, only_results_on_stdout, progress, say, table
from ttscompile.errors import ArtifactChangedError, RuntimeUnavailableError
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.measure.units import ms, share
from ttscompile.plots.frontier import plot_frontier

if TYPE_CHECKING:
    from rich.console import Console

    from ttscompile.measure.points import Comparison


def compare(
    directory: Path,
    artifacts: Mapping[str, Artifact],
    others: Sequence[Path],
    trajectories: Sequence[Path],
    strategies: Sequence[str] = (),
    sparsities: Sequence[float] = (),
    **how: Any,
) -> Comparison:
    """Hold plans against the dense policy on held-out calls; warnings go to standard error.

    Args:
        directory: the artifact.
        artifacts: it and the others, as they were opened before.
        others: where the others are.
        trajectories: recorded episodes.
        strategies: that find plans, too.
        sparsities: for them.
        how: what else ``ttscompile.calibration.compare`` takes.

    Raises:
        ArtifactChangedError: an artifact was replaced meanwhile.
        RuntimeUnavailableError: there is no torch.
    """
    try:
        from ttscompile.calibration.compare import compare as measure
    except ModuleNotFoundError as error:
        raise RuntimeUnavailableError(
            f"-t needs {error.name}, which is not installed. Run: pip install 'ttscompile[compile]'."
        ) from error
    with only_results_on_stdout(), counted_parts() as tell:
        found = measure(directory, trajectories, strategies, sparsities, others, progress=tell, **how)
    pairs = zip((directory, *others), artifacts.values(), strict=True)
    if changed := [path for path, one in pairs if manifest_of(path).identity != one.manifest.identity]:
        raise ArtifactChangedError(f"{changed[0]}: it was replaced meanwhile. Try again.")
    say(progress(), *(f"warning: {warning}" for warning in found.warnings))
    return found


def draw_comparison(found: Comparison, directory: Path, picture: Path) -> str:
    """Draw it, and say so."""
    title = f"{directory.resolve().name}: {found.calls} held-out calls, {_threads(found)}\n{one_line(fingerprint())}"
    plot_frontier(found.points, found.efficient(), found.yardsticks, picture, title)
    return f"wrote {picture}"


def _threads(found: Comparison) -> str:
    return f"{found.threads} thread{'s' * (found.threads > 1)}"


def print_comparison(found: Comparison, output: Console) -> None:
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
        "Error: mean absolute difference of the executed actions, in their units, from those of the dense policy in"
        f" fp32 with the same observation and noise; {found.calls} calls of held-out episodes, each as the first of its"
        f" episode. Latency: medians of the same calls, one stream, {_threads(found)}. Frontier: no other plan is"
        " faster and more accurate.",
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
