"""``ttscompile reuse-tokens``: of new frames compute the tokens whose patches changed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.artifact.settle import settle
from ttscompile.cli.options import artifact_argument, count_option, json_option, seed_option
from ttscompile.cli.output import (
    counted_parts,
    manifest_of,
    only_results_on_stdout,
    print_identity,
    print_json,
    progress,
    results,
    say,
)
from ttscompile.cli.recordings import FilesCommand, Sources, require_recordings, trajectories_options
from ttscompile.cli.types import ERROR
from ttscompile.report.facts import told_reuse


@click.command("reuse-tokens", cls=FilesCommand)
@artifact_argument
@trajectories_options(required=False, what="Choose when a token is computed on these recorded episodes.")
@count_option("--calls", "Choose on so many calls, and judge on as many, at most.", default=256, least=2)
@click.option(
    "--max-action-error",
    type=ERROR,
    help="Allow so large a mean difference of the executed actions, in their units. Without this option it is a tenth"
    " of what other noise changes.",
)
@seed_option("Seed of the division of the episodes and of the noise.")
@click.option("--off", is_flag=True, help="Compute all tokens again, as before.")
@json_option
def reuse_tokens(
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    off: bool,
    as_json: bool,
    **settings: Any,  # ttscompile.reuse_tokens takes them by the same names
) -> None:
    """Reuse tokens of the image encoders of the artifact DIRECTORY from frame to frame.

    A vision transformer computes the tokens whose patches changed since they were last computed; the others keep what
    they gave. When a patch counts as changed, and how often a frame is computed whole, is chosen on recorded episodes
    and judged by the actions on others. Exit status 1: it does not pay, and nothing was changed.
    """
    manifest_of(directory)
    if off == bool(trajectories):
        raise click.UsageError("give --trajectories FILE..., or --off.")
    if off:
        manifest = settle(directory, "reuse", None)
        document: dict[str, Any] = {"identity": manifest.identity, "reuse": None}
        told = "all tokens of new frames are computed"
    else:
        require_recordings(trajectories)
        with only_results_on_stdout(), counted_parts() as tell:
            found = ttscompile.reuse_tokens(
                directory, list(trajectories), observation=sources, progress=tell, **settings
            )
        before, after = found.frame_ms
        document = {
            "identity": manifest_of(directory).identity,
            "reuse": vars(found.reuse),
            "frame_ms": [before, after],
        }
        told = f"{told_reuse(found.reuse)}; a new frame takes {after:.3g} ms, and took {before:.3g}"
        if after >= before:
            say(progress(), "warning: this encoder is so small that its frames are not faster by it on this machine.")
    if as_json:
        print_json(document)
    else:
        say(results(), told)
        print_identity(document["identity"], results())
