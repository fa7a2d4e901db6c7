"""What commands that listen have in common: where, for whom, and until when."""

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

from ttscompile.cli.options import Decorator, count_option, together
from ttscompile.cli.output import say
from ttscompile.cli.types import ADDRESS, FILE, NEW_FILE
from ttscompile.core.paths import require_free_or_path
from ttscompile.errors import ExecutorError, OutputError
from ttscompile.runtimes.server.admission import AUDIT
from ttscompile.runtimes.server.limits import ServerLimits
from ttscompile.runtimes.server.listener import Listener
from ttscompile.runtimes.server.lock import Lock, hashed, read_by_others, read_token, tls_context

if TYPE_CHECKING:
    from rich.console import Console

TOKEN_VARIABLE = "TTSCOMPILE_TOKEN"  # noqa: S105
"""Of the environment; the example client reads it too."""


def server_options(clients: int, most: int) -> Decorator:
    """Where to listen, the lock, the audit, and what clients may do.

    Args:
        clients: that may be connected, where nothing is said.
        most: that may be asked for.
    """
    return together(
        click.option(
            "--host",
            type=ADDRESS,
            default="127.0.0.1",
            show_default=True,
            help="Address to listen on: an IP address of this machine, or localhost. One that other machines may reach"
            " needs a token and a certificate.",
        ),
        click.option(
            "--port",
            type=click.IntRange(0, 65535),
            default=8765,
            show_default=True,
            help="Port to listen on; 0 takes any that is free.",
        ),
        click.option(
            "--token-file",
            type=FILE,
            help=f"File with the token that clients must send. The environment's {TOKEN_VARIABLE} can hold it instead."
            " There is no option for the token itself: other users could read it in the list of processes.",
        ),
        click.option(
            "--tls-certificate",
            type=FILE,
            help="Certificate of the server in PEM format, with those between it and its authority's. Clients use wss://.",
        ),
        click.option("--tls-key", type=FILE, help="Its private key in PEM format, if that is in a file of its own."),
        click.option(
            "--insecure",
            is_flag=True,
            help="Listen beyond this machine without a token or a certificate: whoever reaches the port can drive the"
            " robot.",
        ),
        click.option(
            "--audit-file",
            type=NEW_FILE,
            help="File that a line of JSON is appended to for each connection. Without this option it is standard"
            " error.",
        ),
        count_option("--max-clients", "Clients that may be connected.", default=clients, most=most),
        count_option(
            "--max-clients-per-address",
            "Of these, clients of one address. Without this option it is all of them.",
            default=None,
            most=most,
        ),
        count_option(
            "--max-requests-per-second", "Requests of one client; further ones wait their turn.", default=2000
        ),
        count_option(
            "--max-message-bytes", "Size of a message that is still read.", default=1 << 20, least=128, most=1 << 30
        ),
    )


@dataclass(frozen=True)
class ServerOptions:
    """What ``server_options`` were given as, checked.

    Attributes:
        host: to listen on.
        port: 0 for any that is free.
        lock: who may come in.
        limits: what clients may do.
        audit_file: that the audit goes to; None for standard error.
    """

    host: str
    port: int
    lock: Lock
    limits: ServerLimits
    audit_file: Path | None

    @classmethod
    def taken(cls, options: dict[str, Any], console: Console) -> ServerOptions:
        """Take these options out of those of a command.

        Raises:
            ExecutorError: the token is none, or the address wants a lock; also for TLS, see ``tls_context``.
            UsageError: a key without a certificate.
        """
        token_file, host = options.pop("token_file"), options.pop("host")
        certificate, key = options.pop("tls_certificate"), options.pop("tls_key")
        token_hash = _token_hash(token_file)
        if token_file is not None and read_by_others(token_file):
            say(
                console,
                f"warning: {token_file} may be read by other users of this machine. Run: chmod 600 {token_file}",
            )
        if key is not None and certificate is None:
            raise click.UsageError("--tls-key is the key of a certificate. Give --tls-certificate too.")
        lock = Lock(token_hash, tls_context(certificate, key) if certificate else None, options.pop("insecure"))
        if host != "localhost":  # that name's addresses are looked at when it listens
            lock.require(host)
        limits = ServerLimits(
            clients=options.pop("max_clients"),
            message_bytes=options.pop("max_message_bytes"),
            clients_per_address=options.pop("max_clients_per_address"),
            requests_per_second=options.pop("max_requests_per_second"),
        )
        return cls(host, options.pop("port"), lock, limits, options.pop("audit_file"))

    def warn(self, console: Console) -> None:
        """Say it where whoever comes is let in."""
        if self.lock.insecure and self.lock.missing():
            say(console, f"warning: there is {self.lock.missing()}: whoever reaches {self.host} can drive the robot.")

    @contextmanager
    def audited(self) -> Iterator[None]:
        """Write the audit's lines to the end of a file that nobody else may read, or to standard error.

        Raises:
            OutputError: the file cannot be written.
        """
        handler: logging.Handler = logging.StreamHandler(sys.stderr)
        if self.audit_file is not None:
            require_free_or_path(self.audit_file, OutputError, "Give a file, or leave --audit-file out.")
            try:
                os.close(os.open(self.audit_file, os.O_CREAT | os.O_WRONLY, 0o600))
                handler = logging.FileHandler(self.audit_file, encoding="utf-8")
            except OSError as error:
                raise OutputError(
                    f"{self.audit_file}: cannot be written: {error.strerror}. Give another --audit-file."
                ) from error
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

    async def serve(self, server: Listener, identity: str, output: TextIO | None = None) -> None:
        """Let a server listen until the process is told to end, and write its address, one line of JSON.

        Args:
            server: made with this lock and these limits.
            identity: of the artifact.
            output: that the line goes to; None for standard output.
        """
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
