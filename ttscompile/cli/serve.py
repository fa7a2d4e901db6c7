"""``ttscompile serve``: an artifact drives a robot whose program is another process, in any language."""

from __future__ import annotations

import asyncio
import json
import signal
from pathlib import Path

import click

import ttscompile
from ttscompile.cli.loop_options import loop_options
from ttscompile.cli.output import artifact_argument, progress
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.runtimes.executor.server import ExecutorServer, ServerLimits


@click.command()
@artifact_argument
@loop_options
@click.option("--host", default="127.0.0.1", show_default=True, help="To listen on. There is no authentication.")
@click.option("--port", type=click.IntRange(0, 65535), default=8765, show_default=True, help="0: any that is free.")
@click.option(
    "--tier", "tiers", multiple=True, help="A plan, slowest first; may be repeated. The default plan, if none."
)
@click.option(
    "--seam",
    type=click.Choice(["replace", "blend", "prefix"]),
    default="replace",
    show_default=True,
    help="How a chunk joins the one before.",
)
@click.option(
    "--interpolation",
    type=click.Choice(["hold", "linear"]),
    default="hold",
    show_default=True,
    help="Between actions, if the loop is faster than the policy.",
)
@click.option(
    "--max-hold",
    type=click.IntRange(min=0),
    default=3,
    show_default=True,
    help="Ticks to repeat the last action for, when there is no other.",
)
@click.option("--max-clients", type=click.IntRange(min=1), default=8, show_default=True)
@click.option("--max-message-bytes", type=click.IntRange(min=128), default=1 << 20, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), help="Of the policy's noise.")
def serve(
    directory: Path,
    control_hz: float,
    policy_hz: float | None,
    horizon: int | None,
    host: str,
    port: int,
    margin_ticks: int,
    threads: int,
    tiers: tuple[str, ...],
    seam: str,
    interpolation: str,
    reserve: int | None,
    max_hold: int,
    max_clients: int,
    max_message_bytes: int,
    seed: int | None,
) -> None:
    """Serve the artifact DIRECTORY on a local WebSocket until it is interrupted; docs/serve.md has the protocol.

    The first line on standard output is a JSON object with the url and the artifact's identity; statistics follow at
    the end.
    """
    console = progress()
    settings = ExecutorSettings(
        policy_hz=policy_hz,
        horizon=horizon,
        tiers=tiers or None,
        seam=seam,
        interpolation=interpolation,
        reserve=reserve,
        max_hold=max_hold,
        margin_ticks=margin_ticks,
    )
    with console.status("loading and measuring"):
        policy = ttscompile.load(directory, threads=threads, seed=seed)
        executor = AsyncExecutor(policy, control_hz, settings)
    limits = ServerLimits(clients=max_clients, message_bytes=max_message_bytes)
    if host not in ("127.0.0.1", "::1", "localhost"):
        console.print(
            f"warning: {host} may be reached from other machines, and whoever reaches it can drive the robot.",
            soft_wrap=True,
        )
    with executor:
        asyncio.run(_run(ExecutorServer(executor, limits), host, port, policy.info.identity))
    click.echo(json.dumps({"statistics": executor.statistics().to_json()}, allow_nan=False))


async def _run(server: ExecutorServer, host: str, port: int, identity: str) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for each in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(each, stop.set)
    shown = f"[{host}]" if ":" in host else host

    def bound(number: int) -> None:
        click.echo(json.dumps({"url": f"ws://{shown}:{number}/", "identity": identity}))

    await server.run(host, port, stop, bound)
