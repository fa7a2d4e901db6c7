"""Clients that send too much: pings whose answers they do not read, empty fragments, keys by the thousand."""

from __future__ import annotations

import asyncio
import json
import resource
import socket
import struct
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest

from tests.serving.serving import LIMITS, client, connected, handshake, raw, read_all, serving, still_serves, wait_until
from tests.serving.watching import figures, get
from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import ProtocolError
from ttscompile.serving.admission import ServerLimits
from ttscompile.serving.listener import Listener
from ttscompile.serving.protocol import LARGE, read_request

PATIENT = replace(LIMITS, idle_timeout=30.0, handshake_timeout=10.0, send_timeout=10.0)
"""So that it does not matter what else the machine does."""
PING = b"\x89\x80mask"
FILES = 2048
"""Descriptors that a thousand connections need at most, of clients and of the server in this process together."""
EMPTY = {"pings": PING, "pongs": b"\x8a\x80mask", "fragments": b"\x00\x80mask"}


@pytest.mark.parametrize("kind", EMPTY)
def test_frames_without_content_have_a_pace(kind: str) -> None:
    """100 at once are answered; a few hundred more than that in no time are the end of this client alone."""
    begin = b"\x01\x80mask" if kind == "fragments" else b""
    with serving(limits=PATIENT) as url, connected(url) as other:
        with raw(url) as sock:
            sock.sendall(handshake() + begin + 50 * EMPTY[kind])
            time.sleep(0.05)
            assert other("info")["n_obs_steps"] == 2
            if kind != "fragments":  # which are half a message
                sock.sendall(struct.pack("!BB", 0x81, 0x80 | 20) + bytes(4) + b'{"method": "info"}  ')
                found = b""
                while b'"n_obs_steps": 2' not in found:
                    found += sock.recv(65536)
        with raw(url) as sock:
            sock.sendall(handshake())
            sent, ended = 0, False
            while not ended and sent < 50 * 1000 * len(EMPTY[kind]):
                try:
                    sent += sock.send(begin + 1000 * EMPTY[kind])
                except OSError:  # reset, or a broken pipe
                    ended = True
                assert other("info")["n_obs_steps"] == 2
            assert ended
        assert other("info")["n_obs_steps"] == 2


@pytest.mark.slow
def test_others_are_answered_while_pings_come() -> None:
    """The flood is cut off within its first bytes, over and over: an answer takes as long as without it, but for tens
    of milliseconds where the flood was just read."""
    with serving(limits=replace(PATIENT, clients=8)) as url, connected(url) as other:
        done = Event()

        def flood() -> None:
            while not done.is_set():
                try:
                    with raw(url) as sock:
                        sock.sendall(handshake())
                        while True:
                            sock.sendall(5000 * PING)
                except OSError:
                    pass

        thread = Thread(target=flood)
        thread.start()
        try:
            times = []
            for _ in range(200):
                began = time.monotonic()
                other("info")
                times.append(time.monotonic() - began)
        finally:
            done.set()
            thread.join()
        assert sorted(times)[100] < 0.05


@pytest.mark.slow
def test_a_thousand_connections_at_once() -> None:
    """Few of them are held, the others are closed unread, and who was there before goes on."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < FILES:
        pytest.skip(f"TOO FEW FILES: a thousand connections need {FILES} descriptors, and the hard limit is {hard}")
    resource.setrlimit(resource.RLIMIT_NOFILE, (FILES, hard))
    limits = ServerLimits(handshake_timeout=30.0, action_timeout=10.0)
    try:
        with serving(limits=limits) as url, connected(url) as other, ExitStack() as stack:
            files = len([*Path("/proc/self/fd").iterdir()])
            came = [stack.enter_context(raw(url)) for _ in range(1000)]
            for _ in range(20):
                assert other("info")["n_obs_steps"] == 2
            for each in came:
                each.setblocking(False)
            until = time.monotonic() + 20
            while (held := sum(map(is_open, came))) > limits.handshakes_per_address and time.monotonic() < until:
                time.sleep(0.05)
            assert 0 < held <= limits.handshakes_per_address
            assert len([*Path("/proc/self/fd").iterdir()]) <= files + 1000 + limits.handshakes_per_address
            for each in came:
                each.close()
            still_serves(url)
            assert other("info")["n_obs_steps"] == 2
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def is_open(sock: socket.socket) -> bool:
    """Whether the server has not closed a connection on which nothing was said."""
    try:
        return sock.recv(1) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


@pytest.mark.parametrize("kind", ["too large", "close"])
def test_a_closed_client_that_leaves_its_socket_open_is_gone_soon(kind: str) -> None:
    """Long before its idle timeout, for which the end of the server would wait as well."""
    last = struct.pack("!BBHI", 0x81, 0x80 | 126, 10_000, 0) if kind == "too large" else b"\x88\x80mask"
    with serving(limits=replace(LIMITS, clients=1, idle_timeout=60.0)) as url, raw(url) as sock:
        sock.sendall(handshake())
        assert sock.recv(4096).startswith(b"HTTP/1.1 101")
        sock.sendall(last)
        assert sock.recv(4096)[0] == 0x88, "the server's close"
        wait_until(lambda: figures(get(url, "/metrics")[1])["ttscompile_clients"] == 0)
        still_serves(url)


def test_the_example_s_client_ends_with_its_connection() -> None:
    with serving() as url, connected(url) as call:
        with pytest.raises(ConnectionError, match="1009"):
            call("info", id="x" * 10_000)
        assert call._socket.fileno() == -1
        call.close()
        still_serves(url)


def test_an_address_that_floods_is_cut_off() -> None:
    with serving(limits=replace(PATIENT, refusals_per_minute=2)) as url, connected(url) as other:
        for _ in range(2):
            with raw(url) as sock:
                sock.sendall(handshake() + 5000 * PING)
                read_all(sock)
        with raw(url) as sock:
            assert read_all(sock) == b""
        assert other("info")["n_obs_steps"] == 2, "its clients stay"


def test_large_fragments_are_no_flood() -> None:
    """A camera's message in pieces of 1 KiB, a thousand of them."""
    text = json.dumps({"method": "info", "id": "x" * 400_000}).encode()
    pieces = [text[i : i + 1024] for i in range(0, len(text), 1024)]
    frames = [
        struct.pack("!BBH", (0x01 if i == 0 else 0) | (0x80 if i == len(pieces) - 1 else 0), 0x80 | 126, len(piece))
        + bytes(4)
        + piece
        for i, piece in enumerate(pieces)
    ]
    with serving(limits=replace(PATIENT, message_bytes=1 << 20)) as url, connected(url) as call:
        call._socket.sendall(b"".join(frames))
        assert json.loads(call._receive())["result"]["n_obs_steps"] == 2


def test_a_request_has_as_many_values_as_its_observation_may_need() -> None:
    many = json.dumps({"method": "observe", "obs": {f"k{i}": 0 for i in range(70_000)}})
    began = time.process_time()
    with pytest.raises(ProtocolError, match="a request has at most 20000 values"):
        read_request(many, values=ServerLimits().message_values)
    assert time.process_time() - began < 0.05
    camera = {"camera": ObservationSpec((2, 3, 96, 96)), "state": ObservationSpec((2, 7))}
    limits = ServerLimits.of(camera, 8)
    pixels = [[[[0]] * 96] * 96] * 3
    text = json.dumps({"method": "observe", "obs": {"camera": [pixels, pixels], "state": [[[0]] * 7] * 2}})
    assert read_request(text, values=limits.message_values).large
    assert len(text) > LARGE


def test_many_keys_are_refused_and_hinder_nobody() -> None:
    document = {"method": "observe", "obs": {f"k{i}": [0] for i in range(9_000)}}
    with serving(limits=replace(PATIENT, message_bytes=1 << 20)) as url, connected(url) as call:
        call._send(client.TEXT, json.dumps(document).encode())
        error = json.loads(call._receive())["error"]
        assert error["type"] == "ObservationError"
        assert len(error["message"]) < 1000
        call._send(client.TEXT, json.dumps({**document, "obs": dict.fromkeys(map(str, range(70_000)))}).encode())
        assert "at most 20000 values" in json.loads(call._receive())["error"]["message"]


def test_large_messages_are_read_beside_the_event_loop() -> None:
    """While one is read, the loop goes on."""

    async def run() -> tuple[Any, int]:
        ticks = 0

        async def tick() -> None:
            nonlocal ticks
            while True:
                ticks += 1
                await asyncio.sleep(0.01)

        ticking = asyncio.ensure_future(tick())
        await asyncio.sleep(0)
        found = await Listener.apart(None, True, lambda: time.sleep(0.3) or 7)  # type: ignore[arg-type, func-returns-value]
        ticking.cancel()
        return found, ticks

    found, ticks = asyncio.run(run())
    assert found == 7
    assert ticks > 5
