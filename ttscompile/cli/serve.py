"""``ttscompile serve``: an artifact drives a robot whose program is another process, in any language."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.cli.options import artifact_argument, count_option, loop_options, runtime_options, seed_option
from ttscompile.cli.output import progress, say
from ttscompile.cli.types import ADDRESS, FILE, NEW_FILE, TEXT
from ttscompile.core.paths import require_free_or_path
from ttscompile.errors import ExecutorError, OutputError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.runtimes.executor.door import AUDIT
from ttscompile.runtimes.executor.limits import ServerLimits
from ttscompile.runtimes.executor.lock import Lock, hashed, read_by_others, read_token, tls_context
from ttscompile.runtimes.executor.server import ExecutorServer
from ttscompile.runtimes.executor.settings import INTERPOLATIONS, SEAMS

MOST_CLIENTS = 128
"""A socket each, and threads that wait for actions; a process may have 1024 files open where nothing else is said."""
TOKEN_VARIABLE = "TTSCOMPILE_TOKEN"  # noqa: S105
"""Of the environment; the example client reads it too."""


@click.command()
@artifact_argument
@loop_options
@runtime_options
@click.option(
    "--host",
    type=ADDRESS,
    default="127.0.0.1",
    show_default=True,
    help="Address to listen on: an IP address of this machine, or localhost. One that other machines may reach needs a"
    " token and a certificate.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8765,
    show_default=True,
    help="Port to listen on; 0 takes any that is free.",
)
@click.option(
    "--token-file",
    type=FILE,
    help=f"File with the token that clients must send. The environment's {TOKEN_VARIABLE} can hold it instead. There is"
    " no option for the token itself: other users could read it in the list of processes.",
)
@click.option(
    "--tls-certificate",
    type=FILE,
    help="Certificate of the server in PEM format, with those between it and its authority's. Clients use wss://.",
)
@click.option("--tls-key", type=FILE, help="Its private key in PEM format, if that is in a file of its own.")
@click.option(
    "--insecure",
    is_flag=True,
    help="Listen beyond this machine without a token or a certificate: whoever reaches the port can drive the robot.",
)
@click.option(
    "--audit-file",
    type=NEW_FILE,
    help="File that a line of JSON is appended to for each connection. Without this option it is standard error.",
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
@count_option(
    "--max-clients-per-address",
    "Of these, clients of one address. Without this option it is all of them.",
    default=None,
    most=MOST_CLIENTS,
)
@count_option("--max-requests-per-second", "Requests of one client; further ones wait their turn.", default=2000)
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
    token_file: Path | None,
    tls_certificate: Path | None,
    tls_key: Path | None,
    insecure: bool,
    audit_file: Path | None,
    max_clients: int,
    max_clients_per_address: int | None,
    max_requests_per_second: int,
    max_message_bytes: int,
    seed: int | None,
    **settings: Any,
) -> None:
    """Serve the artifact DIRECTORY on a WebSocket until it is interrupted; docs/serve.md has the protocol.

    The first line on standard output is a JSON object with the url and the artifact's identity; statistics follow at
    the end.
    """
    console = progress()
    token_hash = _token_hash(token_file)
    if token_file is not None and read_by_others(token_file):
        say(console, f"warning: {token_file} may be read by other users of this machine. Run: chmod 600 {token_file}")
    if tls_key is not None and tls_certificate is None:
        raise click.UsageError("--tls-key is the key of a certificate. Give --tls-certificate too.")
    lock = Lock(token_hash, tls_context(tls_certificate, tls_key) if tls_certificate else None, insecure)
    if host != "localhost":  # that name's addresses are looked at when it listens
        lock.require(host)
    limits = ServerLimits(
        clients=max_clients,
        message_bytes=max_message_bytes,
        clients_per_address=max_clients_per_address,
        requests_per_second=max_requests_per_second,
    )
    with _audited(audit_file):
        with console.status("loading and measuring"):
            policy = ttscompile.load(directory, runtime, threads, seed, device=device)
            executor = AsyncExecutor(policy, control_hz, ExecutorSettings(tiers=tiers or None, **settings))
        if insecure and lock.missing():
            say(console, f"warning: there is {lock.missing()}: whoever reaches {host} can drive the robot.")
        with executor:
            asyncio.run(_run(ExecutorServer(executor, limits, lock), host, port, policy.info.identity, lock))
    click.echo(json.dumps({"statistics": executor.statistics().to_json()}, allow_nan=False))


def _token_hash(file: Path | None) -> bytes | None:
    """Of the token in the file or in the environment.

    Raises:
        ExecutorError: both have one, or what is there is none.
    """
    given = os.environ.get(TOKEN_VARIABLE)
    if file is None:
        return None if given is None else hashed(given, f"the environment's {TOKEN_VARIABLE}")
    if given is not None:
        raise ExecutorError(f"there are two tokens, in {TOKEN_VARIABLE} and in {file}. Give one of them.")
    return hashed(read_token(file), str(file))


@contextmanager
def _audited(file: Path | None) -> Iterator[None]:
    """Write the audit's lines to the end of a file that nobody else may read, or to standard error.

    Raises:
        OutputError: the file cannot be written.
    """
    handler: logging.Handler = logging.StreamHandler(sys.stderr)
    if file is not None:
        require_free_or_path(file, OutputError, "Give a file, or leave --audit-file out.")
        try:
            os.close(os.open(file, os.O_CREAT | os.O_WRONLY, 0o600))
            handler = logging.FileHandler(file, encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{file}: cannot be written: {error.strerror}. Give another --audit-file.") from error
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
        handler.close()


async def _run(server: ExecutorServer, host: str, port: int, identity: str, lock: Lock) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for each in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(each, stop.set)

    def bound(address: str, number: int) -> None:
        shown = f"[{address}]" if ":" in address else address
        scheme = "ws" if lock.tls is None else "wss"
        click.echo(json.dumps({"url": f"{scheme}://{shown}:{number}/", "identity": identity}))

    await server.run(host, port, stop, bound)
