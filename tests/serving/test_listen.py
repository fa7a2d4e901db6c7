"""Where the server listens: a name may have several addresses, and a machine not all of them."""

from __future__ import annotations

import asyncio
import errno
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.heard import heard
from tests.runtimes.executor.simulation import FakeClock
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.executor import AsyncExecutor
from ttscompile.serving.admission import Admission, AdmittingSocket
from ttscompile.serving.executor_server import ExecutorServer

from .serving import CLIENT, Quick, serving

V4, V6 = ("127.0.0.1",), ("::1",)


@pytest.mark.skipif(sys.platform == "darwin", reason="127.0.0.2 is no address there")
@pytest.mark.parametrize(
    ("addresses", "broken", "left"),
    [
        ([V4, V4], {}, ["127.0.0.1"]),  # /etc/hosts may say it twice
        ([V6, V4, V6], {}, ["::1", "127.0.0.1"]),
        ([V6, V4], {"make": errno.EAFNOSUPPORT}, ["127.0.0.1"]),
        ([V6, V4], {"bind": errno.EADDRNOTAVAIL}, ["127.0.0.1"]),
        ([V4, V6], {"bind": errno.EADDRNOTAVAIL}, ["127.0.0.1"]),
        ([V6], {"bind": errno.EADDRNOTAVAIL}, None),
        ([V4, V6], {"bind": errno.EACCES}, None),
        ([V4, V6], {"listen": errno.EADDRINUSE}, None),
    ],
)
def test_a_name_s_addresses_have_one_port_and_absent_ones_are_left_out(
    addresses: list[tuple[str]], broken: dict[str, int], left: list[str] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []

    class Socket(AdmittingSocket):
        """Fails where the case says so, for IPv6; which a machine of tests may lack, so IPv4 stands in for it."""

        def __init__(self, admission: Admission, family: int) -> None:
            self.six = family == socket.AF_INET6
            self._fail("make")
            super().__init__(admission, socket.AF_INET)
            made.append(self)

        def _fail(self, step: str) -> None:
            if self.six and step in broken:
                raise OSError(broken[step], "scripted")

        def bind(self, address: Any) -> None:
            self._fail("bind")
            self.asked = address
            super().bind(("127.0.0.2" if self.six else "127.0.0.1", address[1]))

        def listen(self, backlog: int = 0) -> None:
            self._fail("listen")
            super().listen(backlog)

    def found(_: str, port: int, **__: Any) -> list[Any]:
        six, four = (socket.AF_INET6, 1, 6, ""), (socket.AF_INET, 1, 6, "")
        return [(*six, ("::1", port, 0, 0)) if each == V6 else (*four, ("127.0.0.1", port)) for each in addresses]

    async def listen(server: ExecutorServer) -> list[AdmittingSocket]:
        monkeypatch.setattr(
            asyncio.get_running_loop(), "getaddrinfo", lambda *a, **k: asyncio.to_thread(found, *a, **k)
        )
        return await server._listen("localhost", 0)

    monkeypatch.setattr("ttscompile.serving.listener.AdmittingSocket", Socket)
    with AsyncExecutor(Quick(FakeClock()), 20, latencies={"dense": 0.01}) as executor:
        server = ExecutorServer(executor)
        if left is None:
            with pytest.raises(ExecutorError, match="^cannot listen on localhost:0: scripted. Choose"):
                asyncio.run(listen(server))
            assert all(each.fileno() == -1 for each in made)
            return
        with heard() as told:
            entrances = asyncio.run(listen(server))
    assert [each.asked[0] for each in entrances] == left  # type: ignore[attr-defined]
    assert len({each.getsockname()[1] for each in entrances}) == 1
    assert told == (["not listening on ::1: scripted"] if broken else [])
    for each in entrances:
        socket.create_connection(each.getsockname(), 5).close()  # it listens already
    for each in made:
        each.close()


def test_the_example_client_says_that_the_server_ended(tmp_path: Path) -> None:
    told = tmp_path / "told"
    with told.open("w") as errors, serving() as url:
        words = [sys.executable, str(CLIENT), url, "--seconds", "60"]
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=errors, text=True)
        assert process.stdout is not None
        process.stdout.readline()  # of an action, or the end: it has connected
    with process:
        assert process.wait(30) == 1
    assert told.read_text().splitlines()[-1].startswith("error: the ")
    assert told.read_text().endswith("Stop the robot safely.\n")
    assert "Traceback" not in told.read_text()
