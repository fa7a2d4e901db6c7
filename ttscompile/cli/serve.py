"""``ttscompile serve``: an artifact answers programs in other processes, those of one robot or of many."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.options import (
    LOOP_OPTIONS,
    artifact_argument,
    count_option,
    loop_options,
    number_option,
    runtime_options,
    threads_option,
)
from ttscompile.cli.output import only_results_on_stdout, progress
from ttscompile.cli.sections import Section, SectionedCommand
from ttscompile.cli.server_options import FLEET_CLIENTS, ROBOT_CLIENTS, SERVER_OPTIONS, ServerOptions, server_options
from ttscompile.cli.types import ANY_TEXT, RATE, TEXT
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.runtimes.fleet import LOCAL, FleetServer, FleetSettings, OpenPiServer, Plans, ray_copies
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.server.executor_server import ExecutorServer
from ttscompile.runtimes.server.limits import ServerLimits

BATCHES_WAITING = 16
"""Requests of a fleet that may be under way, in full batches of every copy; further ones are refused at once."""

SECTIONS = (
    Section("One robot", LOOP_OPTIONS, ("control_hz",)),
    Section("The policy in this process", ("runtime", "device"), ("control_hz", "openpi")),
    Section("Many robots", ("ray",), ("copies",)),
    Section("Who may connect", SERVER_OPTIONS),
)


@click.command(cls=SectionedCommand, sections=SECTIONS)
@artifact_argument
@number_option("--control-hz", RATE, "Drive one robot, whose control loop has this rate in Hz.")
@count_option(
    "--copies", "Answer many robots, with so many copies of the policy, which run on Ray.", default=None, most=4096
)
@click.option("--openpi", is_flag=True, help="Answer clients of openpi, in openpi's protocol.")
@click.option(
    "--plan",
    "plans",
    type=TEXT,
    multiple=True,
    help="Run this plan. Without this option it is the default plan. With --control-hz it may be repeated, from the"
    " slowest plan to the fastest: a faster one is run when calls are late. With --copies it is the plan of requests"
    " that name none, with --openpi that of all.",
)
@threads_option("Threads that the policy, or each copy of it, computes with.")
@loop_options
@runtime_options
@click.option(
    "--ray",
    type=ANY_TEXT,
    metavar="ADDRESS|local",
    default=LOCAL,
    show_default=True,
    help="Run the copies on this Ray cluster, or on cores of this machine.",
)
@server_options
def serve(
    directory: Path,
    control_hz: float | None,
    copies: int | None,
    openpi: bool,
    plans: tuple[str, ...],
    threads: int,
    runtime: str,
    device: str | None,
    ray: str,
    **options: Any,
) -> None:
    """Serve the artifact DIRECTORY on a WebSocket until it is interrupted.

    With --control-hz it drives one robot, in a control loop; docs/serve.md has the protocol. With --copies it answers
    many robots, each request by itself; docs/howto/fleet.md has that protocol. With --openpi it answers clients of
    openpi. The first line on standard output is a JSON object with url and identity; standard error gets the audit.
    """
    if (control_hz is not None) + (copies is not None) + openpi != 1:
        raise click.UsageError("give --control-hz HZ to drive one robot, or --copies N or --openpi to answer many.")
    if len(plans) > 1 and control_hz is None:
        raise click.UsageError("--copies and --openpi take one --plan.")
    server = ServerOptions.taken(options, progress())
    with server.audited():
        how = {"runtime": runtime, "threads": threads, "device": device}
        if control_hz is not None:
            _serve_robot(directory, server, control_hz, ExecutorSettings(tiers=plans or None, **options), how)
        elif copies is None:
            _serve_openpi(directory, server, how, *plans)
        else:
            _serve_fleet(directory, server, ray, FleetSettings(copies, threads), *plans)


def _serve_robot(
    directory: Path, server: ServerOptions, control_hz: float, settings: ExecutorSettings, how: dict[str, Any]
) -> None:
    """In a control loop, with a policy that is loaded so; statistics follow at the end."""
    console = progress()
    with console.status("loading and measuring"):
        policy = ttscompile.load(directory, **how)
        executor = AsyncExecutor(policy, control_hz, settings)
    server.warn(console)
    with executor:
        limits = ServerLimits.of(policy.info.observation, ROBOT_CLIENTS)
        asyncio.run(server.serve(ExecutorServer(executor, limits, server.lock), policy.info.identity))
    click.echo(json.dumps({"statistics": executor.statistics().to_json()}, allow_nan=False))


def _serve_openpi(directory: Path, server: ServerOptions, how: dict[str, Any], plan: str | None = None) -> None:
    console, artifact = progress(), load_artifact(directory)
    with console.status("loading"):
        openpi = OpenPiServer(artifact, open_policy(artifact, plan=plan, **how), lock=server.lock)
    server.warn(console)
    asyncio.run(server.serve(openpi, artifact.manifest.identity))


def _serve_fleet(
    directory: Path, server: ServerOptions, ray: str, settings: FleetSettings, plan: str | None = None
) -> None:
    console, artifact = progress(), load_artifact(directory)
    Plans.of(artifact, plan)  # before copies are started, which takes a while
    output, identity = sys.stdout, artifact.manifest.identity
    limits = ServerLimits.of(artifact.manifest.spec.observations, FLEET_CLIENTS)
    with (
        only_results_on_stdout(),  # Ray writes what its processes say there
        console.status("starting copies") as status,
        ray_copies(ray, directory, identity, settings) as copies,
    ):
        waiting = BATCHES_WAITING * settings.copies * settings.batch
        fleet = FleetServer(artifact, copies, plan, waiting, limits, server.lock)
        status.stop()
        server.warn(console)
        asyncio.run(server.serve(fleet, identity, output))
