"""``ttscompile fleet``: an artifact answers many robots at once, from copies on a Ray cluster."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Any

import click

from ttscompile.artifact.load import load_artifact
from ttscompile.cli.options import artifact_argument, count_option, threads_option
from ttscompile.cli.output import only_results_on_stdout, progress
from ttscompile.cli.server_options import ServerOptions, server_options
from ttscompile.cli.types import ANY_TEXT, TEXT, Number
from ttscompile.runtimes.fleet import LOCAL, FleetServer, FleetSettings, Plans, ray_copies

MOST_CLIENTS = 4096
"""A socket each."""


@click.command()
@artifact_argument
@click.option(
    "--ray",
    type=ANY_TEXT,
    metavar="ADDRESS|local",
    default=LOCAL,
    show_default=True,
    help="Ray cluster that the copies run on, or one with cores of this machine.",
)
@count_option("--copies", "Copies of the policy.", most=4096)
@threads_option("Threads that each copy computes with.")
@click.option("--plan", type=TEXT, help="Plan of requests that name none. Without this option it is the default plan.")
@count_option("--batch", "Requests of one plan that are one call, at most.", default=16, most=4096)
@click.option(
    "--wait-ms",
    type=Number(0, 10_000),
    default=5.0,
    show_default=True,
    help="Milliseconds that a request waits for others of its plan.",
)
@count_option("--max-waiting", "Requests that may be under way; further ones are refused at once.", default=256)
@server_options(clients=256, most=MOST_CLIENTS)
def fleet(
    directory: Path,
    ray: str,
    copies: int,
    threads: int,
    plan: str | None,
    batch: int,
    wait_ms: float,
    max_waiting: int,
    **options: Any,
) -> None:
    """Answer many robots with the artifact DIRECTORY until it is interrupted; docs/howto/fleet.md has the protocol.

    Each request is an episode of its own. The first line on standard output is a JSON object with the url and the
    artifact's identity. A plain GET of /health and of /metrics is answered on the same port.
    """
    console = progress()
    listening, artifact = ServerOptions.taken(options, console), load_artifact(directory)
    Plans.of(artifact, plan)  # before copies are started, which takes a while
    output = sys.stdout
    settings, identity = FleetSettings(copies, threads, batch, wait_ms), artifact.manifest.identity
    with (
        only_results_on_stdout(),  # Ray writes what its processes say there
        listening.audited(),
        console.status("starting copies") as status,
        ray_copies(ray, directory, identity, settings) as there,
    ):
        server = FleetServer(artifact, there, plan, max_waiting, listening.limits, listening.lock)
        status.stop()
        listening.warn(console)
        asyncio.run(listening.serve(server, identity, output))
