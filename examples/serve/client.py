"""A client of ``ttscompile serve`` in nothing but Python's standard library: what any language needs, in a page.

    ttscompile serve build/pusht/flow/compiled --control-hz 10
    python examples/serve/client.py ws://127.0.0.1:8765/ --seconds 5

Where the server has a token and a certificate:

    python examples/serve/client.py wss://10.0.0.7:8765/ --token-file token --ca certificate.pem

It sends frames in which nothing moves, at the control rate, and prints the actions. The framing is RFC 6455; most
languages have a library for it.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import ipaddress
import json
import os
import socket
import ssl
import struct
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

TEXT, CLOSE, PING, PONG = 1, 8, 9, 10
ACCEPT = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"  # RFC 6455, section 1.3


class ServerError(Exception):
    """What the server answers instead of a result.

    Attributes:
        type: name of the error, such as ``DeadlineMissedError``.
    """

    def __init__(self, type: str, message: str) -> None:
        super().__init__(f"{type}: {message}")
        self.type = type


class Client:
    """One connection; requests are answered in their order.

    Args:
        url: ``ws://127.0.0.1:8765/``, or ``wss://`` where the server has a certificate.
        timeout: seconds that an answer may take.
        token: that the server asks for.
        ca: file with the certificate that the server's own must come from; None for the authorities of this machine.

    Raises:
        ConnectionError: the server did not let this client in.
        ssl.SSLError: it is not the server that the certificate is of.
    """

    def __init__(self, url: str, timeout: float = 35.0, token: str | None = None, ca: str | None = None) -> None:
        parts = urlsplit(url)
        secure = parts.scheme == "wss"
        if token and not secure and not on_this_machine(parts.hostname or ""):
            raise ConnectionError(f"a token for {url} could be read on the way. Use wss://.")
        self._socket = socket.create_connection((parts.hostname, parts.port), timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if secure:  # closes the socket if the certificate is another one
            context = ssl.create_default_context(cafile=ca)
            self._socket = context.wrap_socket(self._socket, server_hostname=parts.hostname)
        self._stream = self._socket.makefile("rb")
        key = base64.b64encode(os.urandom(16)).decode()
        authorization = f"Authorization: Bearer {token}\r\n" if token else ""
        self._socket.sendall(
            f"GET {parts.path or '/'} HTTP/1.1\r\nHost: {parts.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n{authorization}\r\n".encode()
        )
        status = self._stream.readline()
        headers = {}
        while line := self._stream.readline().strip():
            name, _, value = line.decode().partition(":")
            headers[name.lower()] = value.strip()
        expected = base64.b64encode(hashlib.sha1((key + ACCEPT).encode()).digest()).decode()
        if b" 101 " not in status or headers.get("sec-websocket-accept") != expected:
            self._stream.close()
            self._socket.close()
            raise ConnectionError(f"{url} did not accept: {status.decode().strip()}")

    def __call__(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a request and wait for its answer.

        Raises:
            ServerError: the server says what went wrong.
            ConnectionError: the connection ended.
        """
        self._send(TEXT, json.dumps({"method": method, **params}).encode())
        reply = json.loads(self._receive())
        if "error" in reply:
            raise ServerError(**reply["error"])
        result: dict[str, Any] = reply["result"]
        return result

    def close(self) -> None:
        """End the connection; one that has ended is closed as well."""
        with suppress(OSError):
            self._send(CLOSE, struct.pack("!H", 1000))
        self._stream.close()
        self._socket.close()

    def _send(self, kind: int, payload: bytes) -> None:
        size = len(payload)
        if size < 126:
            head = struct.pack("!BB", 0x80 | kind, 0x80 | size)
        elif size < 1 << 16:
            head = struct.pack("!BBH", 0x80 | kind, 0x80 | 126, size)
        else:
            head = struct.pack("!BBQ", 0x80 | kind, 0x80 | 127, size)
        mask = os.urandom(4)
        whole = (mask * (size // 4 + 1))[:size]
        masked = int.from_bytes(payload, "big") ^ int.from_bytes(whole, "big")  # as one number: a camera has megabytes
        self._socket.sendall(head + mask + masked.to_bytes(size, "big"))

    def _receive(self) -> bytes:
        message = b""
        while True:
            first, second = self._read(2)
            size = second & 0x7F
            if size >= 126:
                (size,) = struct.unpack("!H" if size == 126 else "!Q", self._read(2 if size == 126 else 8))
            payload, kind = self._read(size), first & 0x0F
            if kind == PING:
                self._send(PONG, payload)
            elif kind == CLOSE:
                code = struct.unpack("!H", payload[:2])[0] if payload else 1005
                self.close()
                raise ConnectionError(f"the server closed the connection: {code} {payload[2:].decode()}")
            elif kind != PONG:
                message += payload
                if first & 0x80:
                    return message

    def _read(self, size: int) -> bytes:
        data = self._stream.read(size)
        if len(data) < size:
            raise ConnectionError("the connection ended")
        return data


def on_this_machine(host: str) -> bool:
    """Whether what is sent there does not leave the machine."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def main() -> None:
    """Observe and act for a while."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("url", nargs="?", default="ws://127.0.0.1:8765/")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--token-file", type=Path, help="holds the token; without it, TTSCOMPILE_TOKEN may")
    parser.add_argument("--ca", help="certificate, in PEM format, that the server's must come from")
    arguments = parser.parse_args()
    file = arguments.token_file
    token = file.read_text().strip() if file else os.environ.get("TTSCOMPILE_TOKEN")
    try:
        call = Client(arguments.url, token=token, ca=arguments.ca)
    except ConnectionRefusedError:
        sys.exit(f"error: nobody listens at {arguments.url}: start 'ttscompile serve DIR --control-hz 10' first")
    except OSError as error:  # also another certificate than the server's
        sys.exit(f"error: {error}")
    try:
        drive(call, arguments.seconds)
    except OSError as error:  # the server ended, or does not answer
        sys.exit(f"error: {error}. Stop the robot safely.")
    call.close()


def drive(call: Client, seconds: float) -> None:
    """Observe and act for so many seconds, and print the statistics."""
    info = call("info")

    def zeros(shape: list[int]) -> Any:
        return [zeros(shape[1:]) for _ in range(shape[0])] if shape else 0

    frame = {key: zeros(spec["shape"]) for key, spec in info["observation"].items()}
    period = 1 / info["control_hz"]
    start = time.monotonic()
    for tick in range(round(seconds / period)):
        time.sleep(max(start + tick * period - time.monotonic(), 0))
        call("observe", obs=frame)
        try:
            print(call("action", timeout=period / 2)["action"])
        except ServerError as error:
            if error.type not in ("DeadlineMissedError", "StaleObservationError"):
                raise
            print(error, file=sys.stderr)
    print(json.dumps(call("statistics")))


if __name__ == "__main__":
    main()
