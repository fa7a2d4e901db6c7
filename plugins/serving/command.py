"""``ttscompile serve``: an artifact answers programs in other processes, those of one robot or of many.

Its options say where it listens, for whom, and until when.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import click
from rich.console import Console

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.cli import options as shared
from ttscompile.cli.output import only_results_on_stdout, progress, say
from ttscompile.cli.sections import Section, SectionedCommand
from ttscompile.cli.types import ADDRESS, ANY_TEXT, FILE, PATH, RATE, TEXT
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.runtimes.instruct import instruct_of
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.open import require_able

from .admission import AUDIT, ServerLimits
from .copies import LOCAL, FleetSettings, ray_copies
from .executor_server import ExecutorServer
from .fleet import FleetServer, Plans
from .listener import Listener
from .lock import Lock, hashed, read_by_others, read_token, tls_context
from .openpi import OpenPiServer

ROBOT_CLIENTS, FLEET_CLIENTS = 8, 256
"""That may be connected."""

TOKEN_VARIABLE = "TTSCOMPILE_TOKEN"  # noqa: S105
"""Of the environment; the example client reads it too."""


SERVER_OPTIONS = ("host", "port", "token_file", "tls", "insecure")
"""Parameters of ``server_options``."""


def _papers(_: click.Context, __: click.Parameter, files: tuple[Path, ...]) -> tuple[Path, ...]:
    if len(files) > 2:
        raise click.BadParameter(f"expected a certificate, and its key if that is in another file; found {len(files)}.")
    return files


server_options = shared.together(
    click.option(
        "--host",
        type=ADDRESS,
        default="127.0.0.1",
        help="Listen on this IP address of this machine, or on localhost. One that other machines may reach needs a"
        " token and a certificate.",
    ),
    shared.count_option("--port", "Listen on this port; 0 takes any that is free.", default=8765, least=0, most=65535),
    click.option(
        "--token-file",
        type=FILE,
        help=f"Let in clients that send the token in this file. The environment's {TOKEN_VARIABLE} can hold it instead."
        " There is no option for the token itself: other users could read it in the list of processes.",
    ),
    click.option(
        "--tls",
        type=FILE,
        multiple=True,
        metavar="CERTIFICATE [KEY]...",
        callback=_papers,
        help="Show clients this certificate, in PEM format, with those between it and its authority's in the same file;"
        " then its private key, if that is in a file of its own. Clients use wss:// then.",
    ),
    click.option(
        "--insecure",
        is_flag=True,
        help="Listen beyond this machine without a token or a certificate: whoever reaches the port can drive the"
        " robot.",
    ),
)
"""Where to listen, and the lock."""


@dataclass(frozen=True)
class ServerOptions:
    """What ``server_options`` were given as, checked.

    Attributes:
        port: 0 for any that is free.
    """

    host: str
    port: int
    lock: Lock

    @classmethod
    def taken(cls, options: dict[str, Any], console: Console) -> ServerOptions:
        """Take these options out of those of a command.

        Raises:
            ExecutorError: the token is none, or the address wants a lock; also for TLS, see ``tls_context``.
        """
        token_file, host = options.pop("token_file"), options.pop("host")
        papers = options.pop("tls")
        token_hash = _token_hash(token_file)
        if token_file is not None and read_by_others(token_file):
            say(
                console,
                f"warning: {token_file} may be read by other users of this machine. Run: chmod 600 {token_file}",
            )
        lock = Lock(token_hash, tls_context(*papers) if papers else None, options.pop("insecure"))
        if host != "localhost":  # that name's addresses are looked at when it listens
            lock.require(host)
        return cls(host, options.pop("port"), lock)

    def warn(self, console: Console) -> None:
        """Say it where whoever comes is let in."""
        if self.lock.insecure and self.lock.missing():
            say(console, f"warning: there is {self.lock.missing()}: whoever reaches {self.host} can drive the robot.")

    @staticmethod
    @contextmanager
    def audited() -> Iterator[None]:
        """Write the audit's lines to standard error."""
        handler = logging.StreamHandler(sys.stderr)
        before = AUDIT.level, AUDIT.propagate
        AUDIT.addHandler(handler)
        AUDIT.setLevel(logging.INFO)
        AUDIT.propagate = False
        try:
            yield
        finally:
            AUDIT.removeHandler(handler)
            AUDIT.setLevel(before[0])
            AUDIT.propagate = before[1]

    async def serve(self, server: Listener, identity: str, output: TextIO | None = None) -> None:
        """Let a server listen until the process is told to end, and write its address, one line of JSON."""
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        for each in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(each, stop.set)

        def bound(address: str, number: int) -> None:
            shown = f"[{address}]" if ":" in address else address
            scheme = "ws" if self.lock.tls is None else "wss"
            click.echo(json.dumps({"url": f"{scheme}://{shown}:{number}/", "identity": identity}), file=output)

        await server.run(self.host, self.port, stop, bound)


def _token_hash(file: Path | None) -> bytes | None:
    """Of the token in the file or in the environment. Raises ExecutorError: both have one, or what is there is none."""
    given = os.environ.get(TOKEN_VARIABLE)
    if file is None:
        return None if given is None else hashed(given, f"the environment's {TOKEN_VARIABLE}")
    if given is not None:
        raise ExecutorError(f"there are two tokens, in {TOKEN_VARIABLE} and in {file}. Give one of them.")
    return hashed(read_token(file), str(file))


BATCHES_WAITING = 16
"""Requests of a fleet that may be under way, in full batches of every copy; further ones are refused at once."""

SECTIONS = (
    Section("One robot", shared.LOOP_OPTIONS, ("control_hz",)),
    Section("The policy in this process", ("runtime", "device"), ("control_hz", "openpi")),
    Section("Many robots", ("ray",), ("copies",)),
    Section("Who may connect", SERVER_OPTIONS),
)


@click.command(cls=SectionedCommand, sections=SECTIONS)
@shared.artifact_argument
@shared.number_option("--control-hz", RATE, "Drive one robot, whose control loop has this rate in Hz.")
@shared.count_option(
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
@shared.threads_option("Compute with so many threads, in each copy of the policy.")
@shared.loop_options
@click.option(
    "--tokenizer",
    type=PATH,
    help="Read the instructions that clients send as text, the task of an observation or the prompt of openpi's, with"
    " this tokenizer.json, or that of this folder, in place of the artifact's own.",
)
@shared.runtime_options
@click.option(
    "--ray",
    type=ANY_TEXT,
    metavar="ADDRESS|local",
    default=LOCAL,
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
    tokenizer: Path | None,
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
        how = {"runtime": runtime, "threads": threads, "device": device, "tokenizer": tokenizer}
        if control_hz is not None:
            _serve_robot(directory, server, control_hz, ExecutorSettings(tiers=plans or None, **options), how)
        elif copies is None:
            _serve_openpi(directory, server, how, *plans)
        else:
            _serve_fleet(directory, server, ray, FleetSettings(copies, threads), tokenizer, *plans)


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
    directory: Path,
    server: ServerOptions,
    ray: str,
    settings: FleetSettings,
    tokenizer: Path | None,
    plan: str | None = None,
) -> None:
    console, artifact = progress(), load_artifact(directory)
    wanted = Plans.of(artifact, plan).default  # before copies are started, which takes a while
    require_able("onnxruntime", artifact, artifact.plan(wanted))
    instruct = instruct_of(artifact, tokenizer)
    output, identity = sys.stdout, artifact.manifest.identity
    limits = ServerLimits.of(artifact.manifest.spec.observations, FLEET_CLIENTS)
    with (
        only_results_on_stdout(),  # Ray writes what its processes say there
        console.status("starting copies") as status,
        ray_copies(ray, directory, identity, settings) as copies,
    ):
        waiting = BATCHES_WAITING * settings.copies * settings.batch
        fleet = FleetServer(artifact, copies, plan, waiting, limits, server.lock, instruct)
        status.stop()
        server.warn(console)
        asyncio.run(server.serve(fleet, identity, output))
