"""A server in the test's process, and clients that behave or do not."""

from __future__ import annotations

import asyncio
import base64
import importlib.util
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.runtimes.executor.simulation import FakeClock, ScriptedPolicy
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.serving.admission import ServerLimits
from ttscompile.serving.executor_server import ExecutorServer
from ttscompile.serving.listener import Listener
from ttscompile.serving.lock import Lock

CLIENT = Path(__file__).parents[2] / "examples" / "serve" / "client.py"
spec = importlib.util.spec_from_file_location("serve_client", CLIENT)
assert spec is not None
assert spec.loader is not None
client = importlib.util.module_from_spec(spec)
spec.loader.exec_module(client)
Client, ServerError = client.Client, client.ServerError

LIMITS = ServerLimits(
    clients=4,
    message_bytes=4096,
    handshake_timeout=0.3,
    idle_timeout=0.6,
    send_timeout=0.3,
    action_timeout=2.0,
    refusals_per_minute=1000,
)

SETTINGS = ExecutorSettings(max_hold=1000)


class Quick(ScriptedPolicy):
    def predict_action(self, obs_dict: Any, *, plan: str) -> Any:
        time.sleep(0.002)
        return {"action_pred": np.full((1, 16, 3), obs_dict["obs"][0, -1, 0])}


class Broken(Quick):
    def predict_action(self, obs_dict: Any, *, plan: str) -> Any:
        raise ZeroDivisionError("scripted")


@contextmanager
def serving(
    policy: type[ScriptedPolicy] = Quick,
    limits: ServerLimits = LIMITS,
    settings: ExecutorSettings = SETTINGS,
    lock: Lock | None = None,
) -> Iterator[str]:
    """A server in this process; its url."""
    executor = AsyncExecutor(policy(FakeClock()), 20, settings, latencies={"dense": 0.01})
    try:
        with listening(lambda: ExecutorServer(executor, limits, lock), lock) as url:
            yield url
    finally:
        try:
            executor.close()
        except ExecutorError:
            assert policy is Broken


@contextmanager
def listening(make: Callable[[], Listener], lock: Lock | None = None) -> Iterator[str]:
    """Any server in this process, in a thread; its url."""
    ready: list[Any] = []
    started = threading.Event()

    async def run() -> None:
        stop = asyncio.Event()

        def on_start(_: str, port: int) -> None:
            ready.extend([asyncio.get_running_loop(), stop, port])
            started.set()

        await make().run("127.0.0.1", 0, stop, on_start)

    thread = threading.Thread(target=lambda: asyncio.run(run()))
    thread.start()
    assert started.wait(10)
    loop, stop, port = ready
    try:
        yield f"{'wss' if lock and lock.tls else 'ws'}://127.0.0.1:{port}/"
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(10)
        assert not thread.is_alive()


@contextmanager
def connected(url: str, **key: Any) -> Iterator[Any]:
    call = Client(url, timeout=5.0, **key)
    try:
        yield call
    finally:
        vanish(call)


def vanish(call: Any) -> None:
    """Close the socket without a word."""
    call._stream.close()
    call._socket.close()


def wait_until(there: Any) -> None:
    for _ in range(1000):
        if there():
            return
        time.sleep(0.005)
    raise AssertionError("it did not come")


def still_serves(url: str, **key: Any) -> None:
    with connected(url, **key) as call:
        assert call("info")["n_obs_steps"] == 2


def raw(url: str) -> socket.socket:
    port = int(url.rsplit(":", 1)[1].rstrip("/"))
    return socket.create_connection(("127.0.0.1", port), 5)


def handshake(*headers: str) -> bytes:
    key = base64.b64encode(b"0123456789abcdef").decode()
    return (
        "GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n" + "".join(f"{each}\r\n" for each in (*headers, ""))
    ).encode()


def read_all(sock: socket.socket) -> bytes:
    sock.settimeout(5)
    data = b""
    try:
        while part := sock.recv(65536):
            data += part
    except ConnectionResetError:
        pass
    return data


def agreed(client: ssl.SSLContext, server: ssl.SSLContext) -> str:
    """The cipher that the two agree on, without a network between them."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        client.wrap_bio(to_client, to_server, server_hostname="127.0.0.1"),
        server.wrap_bio(to_server, to_client, server_side=True),
    ]
    for _ in range(4):
        for end in ends:
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
    cipher = ends[0].cipher()
    assert cipher is not None
    return cipher[0]


def weakened(papers: Path, ciphers: str) -> tuple[ssl.SSLContext, ssl.SSLContext]:
    """A client and a server that have these ciphers alone; skips where OpenSSL has none of them."""
    weak = ssl.create_default_context(cafile=papers / "ca.pem")
    careless = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    careless.load_cert_chain(papers / "rsa.pem")
    for each in (weak, careless):
        each.maximum_version = ssl.TLSVersion.TLSv1_2
        try:
            each.set_ciphers(ciphers)
        except ssl.SSLError as error:
            pytest.skip(f"NO WEAK CIPHERS: OpenSSL here has none of {ciphers} ({error})")
    return weak, careless
