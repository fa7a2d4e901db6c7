"""What each part of a speed-up is worth: the compiler, the steps that are left out, and the eight bits.

    python examples/benchmark/factors.py DIR --checkpoint CHECKPOINT [--calls 20] [--json]

DIR is an artifact that holds int8, as ``ttscompile build`` makes it, and CHECKPOINT what it was made from. On one core
these take turns: the original in eager PyTorch, the same through ``torch.compile``, everything computed in fp32, the
default plan in fp32, and the default plan as it is. Each row says how many times faster it is than the one before.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
import torch
from networks import Network
from rounds import eager_contestant, torch_compile_contestant

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.cli.contestants import Way, contestants, original_policy
from ttscompile.cli.output import print_json, progress, results_console, run, say, table, warn_if_busy
from ttscompile.core.plan import DENSE
from ttscompile.errors import RuntimeUnavailableError
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.report.timing import Contestant, Measurement, measure


def contestants_of(artifact: Artifact, checkpoint: Path) -> list[Contestant]:
    """From the original to the default plan; without ``torch.compile`` where it cannot be had, which is said."""
    module, spec = original_policy(checkpoint, artifact.manifest.spec)
    network = Network(checkpoint.name, 0, module.eval(), spec)
    made = [eager_contestant(network, 1)]
    try:
        made.append(torch_compile_contestant(network, 1, threads=1))
    except RuntimeUnavailableError as error:
        say(progress(), f"warning: {error}")
    plan = artifact.manifest.default_plan
    plans = [plan] if artifact.default.precision else []
    return [*made, *contestants({"": artifact}, [DENSE, f"{plan}@fp32", *plans], [Way()])]


def rows(measured: Sequence[Measurement], words: Sequence[str]) -> list[dict[str, float | str]]:
    """Of each contestant its name, ``ms``, and how many times faster it is than the one before and than the first."""
    times = [one.median_ms for one in measured]
    # A default without eight bits was measured once: the last of the words has no time.
    return [
        {"what": what, "ms": ms, "than_before": before / ms, "than_first": times[0] / ms}
        for what, ms, before in zip(words, times, [times[0], *times], strict=False)
    ]


@click.command()
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@click.option("--checkpoint", required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--calls", default=20, show_default=True, type=click.IntRange(1), help="Counted calls of each.")
@click.option("--json", "as_json", is_flag=True)
def main(directory: Path, checkpoint: Path, calls: int, as_json: bool) -> None:
    """Time the original in CHECKPOINT and the plans of the artifact DIRECTORY in turn, and tell the factors apart."""
    warn_if_busy(progress())
    artifact = load_artifact(directory)
    torch.set_num_threads(1)
    with torch.inference_mode():
        entered = contestants_of(artifact, checkpoint)
        measured = measure(entered, calls, seed=0)
    named = artifact.manifest.default_plan
    own = [one.label for one in entered if one.policy is None]
    words = [*own, "compiled, all computed, fp32", *(artifact.plan(one).in_words() for one in (f"{named}@fp32", named))]
    found = rows(measured, words)
    if as_json:
        print_json({"machine": one_line(fingerprint()), "rows": found})
        return
    shown = [
        (str(one["what"]), f"{one['ms']:.4g}", f"{one['than_before']:.2f} x", f"{one['than_first']:.3g} x")
        for one in found
    ]
    results_console().print(table("", "ms a call", "than the row before", "than PyTorch", rows=shown))
    say(results_console(), f"Medians of {calls} calls, one thread.", one_line(fingerprint()))


if __name__ == "__main__":
    run(main)
