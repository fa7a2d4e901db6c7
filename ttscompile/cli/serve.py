"""``ttscompile serve``: an artifact drives a robot whose program is another process, in any language."""

from __future__ import annotations

import asyncio
import json
import signal
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.cli.options import artifact_argument, count_option, loop_options, runtime_options, seed_option
from ttscompile.cli.output import progress, say
from ttscompile.cli.types import ADDRESS, TEXT
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.runtimes.executor.server import ExecutorServer, ServerLimits
from ttscompile.runtimes.executor.settings import INTERPOLATIONS, SEAMS

MOST_CLIENTS = 128
"""A socket each, and threads that wait for actions; a process may have 1024 files open where nothing else is said."""


@click.command()
@artifact_argument
@loop_options
@runtime_options
@click.option(
    "--host",
    type=ADDRESS,
    default="127.0.0.1",
    show_default=True,
    help="Address to listen on: an IP address of this machine, or localhost. There is no authentication.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8765,
    show_default=True,
    help="Port to listen on; 0 takes any that is free.",
)
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
@count_option("--max-clients", "Clients that may be connected.", default=8, most=MOST_CLIENTS)
@count_option("--max-message-bytes", "Size of a message that is still read.", default=1 << 20, least=128, most=1 << 30)
@seed_option("Seed of the policy's noise. Without this option each run draws other noise.", default=None)
def serve(
    directory: Path,
    control_hz: float,
    host: str,
    port: int,
    threads: int,
    runtime: str,
    device: str | None,
    tiers: tuple[str, ...],
    max_clients: int,
    max_message_bytes: int,
    seed: int | None,
    **settings: Any,
) -> None:
    """Serve the artifact DIRECTORY on a local WebSocket until it is interrupted; docs/serve.md has the protocol.

    The first line on standard output is a JSON object with the url and the artifact's identity; statistics follow at
    the end.
    """
    console = progress()
    with console.status("loading and measuring"):
        policy = ttscompile.load(directory, runtime, threads, seed, device=device)
        executor = AsyncExecutor(policy, control_hz, ExecutorSettings(tiers=tiers or None, **settings))
    limits = ServerLimits(clients=max_clients, message_bytes=max_message_bytes)
    if host != "localhost" and not ip_address(host).is_loopback:
        say(console, f"warning: {host} may be reached from other machines, and whoever reaches it can drive the robot.")
    with executor:
        asyncio.run(_run(ExecutorServer(executor, limits), host, port, policy.info.identity))
    click.echo(json.dumps({"statistics": executor.statistics().to_json()}, allow_nan=False))


async def _run(server: ExecutorServer, host: str, port: int, identity: str) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for each in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(each, stop.set)

    def bound(address: str, number: int) -> None:
        shown = f"[{address}]" if ":" in address else address
        click.echo(json.dumps({"url": f"ws://{shown}:{number}/", "identity": identity}))

    await server.run(host, port, stop, bound)
