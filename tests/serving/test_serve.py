"""The server: what it answers, and what it survives."""

from __future__ import annotations

import asyncio
import base64
import importlib.util
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from tests.runtimes.executor.simulation import FakeClock
from ttscompile.cli import main
from ttscompile.errors import ExecutorError, RuntimeUnavailableError
from ttscompile.runtimes.executor import AsyncExecutor
from ttscompile.serving.admission import ServerLimits
from ttscompile.serving.executor_server import ExecutorServer

from .serving import (
    CLIENT,
    LIMITS,
    Broken,
    Client,
    Quick,
    ServerError,
    client,
    connected,
    handshake,
    raw,
    read_all,
    serving,
    still_serves,
    vanish,
)

pytestmark = pytest.mark.alone

if importlib.util.find_spec("websockets") is None:
    pytest.skip(
        "NO SERVER TESTS: websockets is not installed; pip install 'ttscompile[serve]'", allow_module_level=True
    )


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with serving() as address:
        yield address


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> None:
    """In place of the check of the other tests: the server of this module runs on."""


def drive(call: Any, value: float, ticks: int) -> list[list[float]]:
    made = []
    start = time.monotonic()
    for tick in range(ticks):
        time.sleep(max(start + tick / 20 - time.monotonic(), 0))
        call("observe", obs={"obs": [value, 0.0]})
        try:
            made.append(call("action", timeout=0.02)["action"])
        except ServerError as error:
            if error.type not in ("DeadlineMissedError", "StaleObservationError"):
                raise
    return made


def test_a_client_drives_a_robot(url: str) -> None:
    with connected(url) as call:
        info = call("info")
        assert info["observation"] == {"obs": {"shape": [2], "dtype": "float64"}}
        assert (info["control_hz"], info["policy_hz"]) == (20, 20)
        assert abs(info["time"] - time.monotonic()) < 1
        call("reset", seed=3)
        made = drive(call, 7.0, 8)
        assert len(made) >= 5
        assert made[-1] == [7.0, 7.0, 7.0]
        call("reset")
        assert drive(call, 8.0, 8)[-1] == [8.0, 8.0, 8.0]
        statistics = call("statistics")
        assert statistics["resets"] == 2
        assert statistics["latency_ms"]["p50"] > 0
        call.close()


def test_arrays_may_be_packed(url: str) -> None:
    packed = {"dtype": "float64", "shape": [2], "base64": base64.b64encode(struct.pack("<2d", 1, 2)).decode()}
    with connected(url) as call:
        assert call("observe", obs={"obs": packed}) == {}


@pytest.mark.parametrize(
    ("message", "type_", "text"),
    [
        ("{", "ProtocolError", "no JSON"),
        ("[1]", "ProtocolError", "found list"),
        ("[" * 3000, "ProtocolError", "no JSON"),
        ('{"method": "explode"}', "ProtocolError", "one of info, observe, action, reset, statistics; found 'explode'"),
        ('{"method": ["info"]}', "ProtocolError", "one of info"),
        ('{"method": "info", "more": 1}', "ProtocolError", "found 'more'"),
        ('{"method": "info", "id": 1.5}', "ProtocolError", "id is a number without fraction"),
        ('{"method": "action", "t": "soon"}', "ProtocolError", "t is a number of seconds"),
        ('{"method": "action", "t": NaN}', "ProtocolError", "NaN is no JSON number"),
        ('{"method": "action", "t": 1e999}', "ProtocolError", "t is a number of seconds"),
        ('{"method": "action", "t": 1%s}' % ("0" * 400), "ProtocolError", "t is a number of seconds"),
        ('{"method": "action", "t": -1e14}', "ExecutorError", "s from now. Give times of time.monotonic()"),
        (
            '{"method": "observe", "obs": {"obs": [1, 2]}, "t": 1e14}',
            "ObservationError",
            "ahead of the executor's clock",
        ),
        ('{"method": "action", "timeout": true}', "ProtocolError", "timeout is a number"),
        ('{"method": "action", "timeout": 3}', "ProtocolError", "at most 2 s"),
        ('{"method": "reset", "seed": -1}', "ProtocolError", "seed"),
        ('{"method": "observe"}', "ProtocolError", "needs obs"),
        ('{"method": "observe", "obs": {"obs": [[1], [1, 2]]}}', "ProtocolError", "no array"),
        ('{"method": "observe", "obs": {"obs": ["1", "2"]}}', "ProtocolError", "lists of numbers"),
        ('{"method": "observe", "obs": {"obs": [1e999, 0]}}', "ObservationError", "finite"),
        (
            '{"method": "observe", "obs": {"obs": {"dtype": "f8", "shape": [9], "base64": ""}}}',
            "ProtocolError",
            "base64",
        ),
        *(
            (
                '{"method": "observe", "obs": {"obs": {"dtype": "f8", "shape": SHAPE, "base64": ""}}}'.replace(
                    "SHAPE", shape
                ),
                "ProtocolError",
                text,
            )
            for shape, text in (
                ("[-1]", "with a shape that is one"),
                ("[1.5]", "with a shape that is one"),
                ("[1e999]", "with a shape that is one"),
                ('"12"', "with a shape that is one"),
                ("[1%s]" % (30 * "0"), "dtype, shape and base64"),
            )
        ),
        *(
            (
                '{"method": "observe", "obs": {"obs": {"dtype": "DTYPE", "shape": [1], "base64": ""}}}'.replace(
                    "DTYPE", dtype
                ),
                "ProtocolError",
                "must be of integers or floats",
            )
            for dtype in (",", "2)", "O", "f8,f8", "(2,2)f8", "")  # numpy makes a SyntaxError of the first two
        ),
        (
            '{"method": "observe", "obs": {"obs": [1, 2, 3]}}',
            "ObservationError",
            r"must be float64 [2]; found float64 [3]",
        ),
        ('{"method": "observe", "obs": {"camera": [1]}}', "ObservationError", "keys ['obs']"),
        (
            '{"method": "observe", "obs": {"obs": [1, 2]}, "t": 1e12}',
            "ObservationError",
            "ahead of the executor's clock",
        ),
    ],
)
def test_a_malformed_request_is_answered_and_the_connection_lives(
    url: str, message: str, type_: str, text: str
) -> None:
    with connected(url) as call:
        call._send(client.TEXT, message.encode())
        error = json.loads(call._receive())["error"]
        assert error["type"] == type_
        assert text in error["message"]
        assert call("info")["n_obs_steps"] == 2


def test_answers_carry_the_id_of_the_request(url: str) -> None:
    with connected(url) as call:
        for document in (
            {"id": "a", "method": "info"},
            {"id": 7, "method": "explode"},
            {"id": 8, "method": "action", "t": 0},
        ):
            call._send(client.TEXT, json.dumps(document).encode())
            assert json.loads(call._receive())["id"] == document["id"]


def test_binary_messages_are_refused(url: str) -> None:
    with connected(url) as call:
        call._send(2, b"\x00\xff")
        assert "not a binary one" in json.loads(call._receive())["error"]["message"]
        call._send(client.TEXT, b"\xff\xfe")  # no UTF-8: the library closes, with the code for it
        with pytest.raises(ConnectionError, match="1007"):
            call._receive()
    still_serves(url)


def test_an_oversized_message_closes_its_sender_with_the_reason(url: str) -> None:
    with connected(url) as call, connected(url) as other:
        with pytest.raises(ConnectionError, match="1009"):
            call("observe", obs={"obs": [0.0] * 5000})
        assert other("info")["max_message_bytes"] == 4096
    with raw(url) as sock:  # a header that announces 2**62 bytes, and nothing after it
        sock.sendall(handshake())
        assert b" 101 " in sock.recv(4096)
        sock.sendall(struct.pack("!BBQ", 0x81, 0x80 | 127, 1 << 62) + b"mask")
        assert b"\x03\xf1" in read_all(sock)  # 1009
    still_serves(url)


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"GET / HT",
        b"\x00\xff\x00\xff\r\n\r\n",
        handshake()[:-2],
        handshake() + b"\x81",
        handshake() + b"\x81\x85abcd\x01",
        handshake() + b"\x01\x85abcd\x01\x02\x03\x04\x05",  # a first fragment without an end
        handshake() + b"\xff\xff\xff\xff",
    ],
)
def test_what_is_half_sent_is_ended_by_a_timeout_and_hinders_nobody(url: str, sent: bytes) -> None:
    with raw(url) as sock:
        sock.sendall(sent)
        still_serves(url)
        start = time.monotonic()
        read_all(sock)
        assert time.monotonic() - start < 3
    still_serves(url)


def test_clients_that_vanish_are_forgotten(url: str) -> None:
    for _ in range(3 * LIMITS.clients):
        with raw(url) as sock:
            sock.sendall(handshake() + b"\x81\x85ab")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset, not closed
    deadline = time.monotonic() + 5
    while True:
        try:
            still_serves(url)
            return
        except ConnectionError:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_a_client_that_vanishes_while_it_waits_hinders_nobody() -> None:
    with serving() as url:
        for _ in range(LIMITS.clients):
            with connected(url) as call:
                call._send(client.TEXT, b'{"method": "action", "timeout": 2}')
        time.sleep(0.1)
        with connected(url) as call:
            start = time.monotonic()
            call("observe", obs={"obs": [0.0, 0.0]})
            assert time.monotonic() - start < 1


def test_a_client_that_does_not_read_is_cut_off_and_the_others_are_served(url: str) -> None:
    request = json.dumps({"method": "info", "id": "x" * 3000}).encode()
    frame = struct.pack("!BBH", 0x81, 0x80 | 126, len(request)) + b"\0\0\0\0" + request
    with raw(url) as sock, connected(url) as other:
        sock.sendall(handshake())
        sock.settimeout(0.05)
        pending, deadline = b"", time.monotonic() + 30
        with pytest.raises(ConnectionError):  # noqa: PT012
            while time.monotonic() < deadline:
                pending = pending or 100 * frame
                try:
                    pending = pending[sock.send(pending) :]
                except TimeoutError:  # the buffers are full
                    assert other("info")["n_obs_steps"] == 2
    still_serves(url)


def test_too_many_clients_are_told(url: str) -> None:
    calls = [Client(url) for _ in range(LIMITS.clients)]
    with pytest.raises(ConnectionError, match="503"):
        Client(url)
    vanish(calls.pop())
    deadline = time.monotonic() + 5
    while len(calls) < LIMITS.clients and time.monotonic() < deadline:
        try:
            calls.append(Client(url))
        except ConnectionError:
            time.sleep(0.02)
    assert len(calls) == LIMITS.clients
    for call in calls:
        vanish(call)


def test_web_pages_are_kept_out(url: str) -> None:
    with raw(url) as sock:
        sock.sendall(handshake()[:-2] + b"Origin: http://example.org\r\n\r\n")
        assert b" 403 " in read_all(sock).split(b"\r\n")[0]


def test_the_error_of_a_dead_worker_reaches_the_clients() -> None:
    with serving(Broken) as url, connected(url) as call:
        with pytest.raises(ServerError, match="WorkerDeadError: .*ZeroDivisionError: scripted"):
            drive(call, 0.0, 10)
        with pytest.raises(ServerError, match="WorkerDeadError"):
            call("reset")


def test_limits_are_checked_and_a_port_that_is_taken_is_told() -> None:
    with pytest.raises(ExecutorError, match="clients must be an integer of at least 1; found 0"):
        ServerLimits(clients=0)
    executor = AsyncExecutor(Quick(FakeClock()), 20, latencies={"dense": 0.01})
    with executor, socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for bad in (70000, -1, True, 8.5):
            with pytest.raises(ExecutorError, match="port must be an integer of at least 0 and at most 65535; found"):
                asyncio.run(ExecutorServer(executor).run("127.0.0.1", bad, asyncio.Event()))  # type: ignore[arg-type]
        with pytest.raises(ExecutorError, match=f"cannot listen on 127.0.0.1:{port}"):
            asyncio.run(ExecutorServer(executor).run("127.0.0.1", port, asyncio.Event()))


@pytest.mark.parametrize(
    ("host", "port", "why"),
    [
        ("", 0, "cannot listen: host is empty"),
        ("a" * 300, 0, "cannot listen on a+:0: .*label"),
        ("\udcff", 0, r"cannot listen on \\udcff:0: "),
        ("127.0.0.1", 2**40, "port must be an integer of at least 0 and at most 65535"),
    ],
)
def test_what_is_no_address_is_an_error(host: str, port: int, why: str) -> None:
    executor = AsyncExecutor(Quick(FakeClock()), 20, latencies={"dense": 0.01})
    with executor, pytest.raises(ExecutorError, match=why):
        asyncio.run(ExecutorServer(executor).run(host, port, asyncio.Event()))


def test_the_server_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    with (
        AsyncExecutor(Quick(FakeClock()), 20, latencies={"dense": 0.01}) as executor,
        pytest.raises(RuntimeUnavailableError, match=r"pip install 'ttscompile\[serve\]'"),
    ):
        asyncio.run(ExecutorServer(executor).run("127.0.0.1", 0, asyncio.Event()))


def test_a_tokenizer_that_the_policy_has_no_use_for_is_refused(toy_compiled: Path, tmp_path: Path) -> None:
    """With copies before they are started."""
    for mode in (["--openpi"], ["--copies", "2"]):
        result = CliRunner().invoke(main, ["serve", str(toy_compiled), *mode, "--tokenizer", str(tmp_path)])
        assert (result.exit_code, result.stdout) == (2, "")
        assert "this policy takes no text that alone would give its tokens. Leave the tokenizer out." in result.stderr


@pytest.mark.slow
def test_the_command_serves_the_example_client_until_it_is_interrupted(toy_compiled: Path) -> None:
    code = "from ttscompile.cli import main; main()"
    command = [sys.executable, "-P", "-c", code, "serve", str(toy_compiled), "--control-hz", "10", "--port", "0"]
    command += ["--margin-ticks", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            first = server.stdout.readline()
            assert first, server.stderr.read() if server.stderr else ""
            url = json.loads(first)["url"]
            done = subprocess.run(
                [sys.executable, "-I", str(CLIENT), url, "--seconds", "1"],
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
            assert done.returncode == 0, done.stderr
            assert json.loads(done.stdout.splitlines()[-1])["frames"] == 10
        finally:
            os.kill(server.pid, signal.SIGINT)
        out, err = server.communicate(timeout=30)
    assert server.returncode == 0, err
    assert json.loads(out)["statistics"]["frames"] == 10
