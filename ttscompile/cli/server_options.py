"""Where a server listens, for whom, and until when."""

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
from typing import TYPE_CHECKING, Any, TextIO

import click

from ttscompile.cli.options import count_option, together
from ttscompile.cli.output import say
from ttscompile.cli.types import ADDRESS, FILE
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.server.admission import AUDIT
from ttscompile.runtimes.server.listener import Listener
from ttscompile.runtimes.server.lock import Lock, hashed, read_by_others, read_token, tls_context

if TYPE_CHECKING:
    from rich.console import Console

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


server_options = together(
    click.option(
        "--host",
        type=ADDRESS,
        default="127.0.0.1",
        show_default=True,
        help="Listen on this IP address of this machine, or on localhost. One that other machines may reach needs a"
        " token and a certificate.",
    ),
    count_option("--port", "Listen on this port; 0 takes any that is free.", default=8765, least=0, most=65535),
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
        help="Certificate of the server in PEM format, with those between it and its authority's in the same file; then"
        " its private key, if that is in a file of its own. Clients use wss:// then.",
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
