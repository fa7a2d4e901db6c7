"""``ttscompile serve``: an artifact drives a robot whose program is another process, in any language."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.cli.options import artifact_argument, count_option, loop_options, runtime_options, seed_option
from ttscompile.cli.output import progress
from ttscompile.cli.server_options import ServerOptions, server_options
from ttscompile.cli.types import TEXT
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.runtimes.executor.settings import INTERPOLATIONS, SEAMS
from ttscompile.runtimes.server.executor_server import ExecutorServer

MOST_CLIENTS = 128
"""A socket each, and threads that wait for actions; a process may have 1024 files open where nothing else is said."""


@click.command()
@artifact_argument
@loop_options
@runtime_options
@server_options(clients=8, most=MOST_CLIENTS)
@click.option(
    "--tier",
    "tiers",
    type=TEXT,
    multiple=True,
    help="A plan to run; may be repeated, from the slowest to the fastest, which are fallen back to when calls are"
    " late. Without this option it is the default plan.",
)
@click.option(
    "--seam",
    type=click.Choice(SEAMS),
    default="replace",
    show_default=True,
    help="How a chunk of actions joins the one before it.",
)
@click.option(
    "--interpolation",
    type=click.Choice(INTERPOLATIONS),
    default="hold",
    show_default=True,
    help="What is between two actions where the control loop is faster than the policy.",
)
@count_option(
    "--max-hold", "Control ticks for which the last action is repeated when there is no other.", default=3, least=0
)
@seed_option("Seed of the policy's noise. Without this option each run draws other noise.", default=None)
def serve(
    directory: Path,
    control_hz: float,
    threads: int,
    runtime: str,
    device: str | None,
    tiers: tuple[str, ...],
    seed: int | None,
    **options: Any,
) -> None:
    """Serve the artifact DIRECTORY on a WebSocket until it is interrupted; docs/serve.md has the protocol.

    The first line on standard output is a JSON object with the url and the artifact's identity; statistics follow at
    the end.
    """
    console = progress()
    listening = ServerOptions.taken(options, console)
    with listening.audited():
        with console.status("loading and measuring"):
            policy = ttscompile.load(directory, runtime, threads, seed, device=device)
            executor = AsyncExecutor(policy, control_hz, ExecutorSettings(tiers=tiers or None, **options))
        listening.warn(console)
        with executor:
            server = ExecutorServer(executor, listening.limits, listening.lock)
            asyncio.run(listening.serve(server, policy.info.identity))
    click.echo(json.dumps({"statistics": executor.statistics().to_json()}, allow_nan=False))
