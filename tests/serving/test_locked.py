"""A token, TLS, limits and an audit: who may come in, and what is written down about it."""

from __future__ import annotations

import asyncio
import hmac
import importlib.util
import json
import os
import signal
import socket
import ssl
import struct
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from click.testing import CliRunner

from tests.runtimes.executor.simulation import FakeClock
from ttscompile.cli import main
from ttscompile.cli.types import PathName
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.executor import AsyncExecutor
from ttscompile.serving.executor_server import ExecutorServer
from ttscompile.serving.lock import Lock, hashed, read_token, tls_context

from .serving import (
    CLIENT,
    LIMITS,
    Client,
    Quick,
    agreed,
    client,
    connected,
    handshake,
    raw,
    read_all,
    serving,
    still_serves,
    weakened,
)

if importlib.util.find_spec("websockets") is None or importlib.util.find_spec("trustme") is None:
    pytest.skip("NO LOCK TESTS: websockets or trustme is not installed; see CONTRIBUTING", allow_module_level=True)

import trustme

TOKEN = "a-Token.of_the~test+made/by=nobody".replace("=", "-")
OTHER = TOKEN[:-1] + "x"


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an authority, the server's certificate and key, and another authority."""
    folder = tmp_path_factory.mktemp("papers")
    authority = trustme.CA()
    issued = authority.issue_cert("127.0.0.1", "localhost")
    authority.cert_pem.write_to_path(folder / "ca.pem")
    trustme.CA().cert_pem.write_to_path(folder / "other_ca.pem")
    issued.cert_chain_pems[0].write_to_path(folder / "certificate.pem")
    issued.private_key_pem.write_to_path(folder / "key.pem")
    issued.private_key_and_cert_chain_pem.write_to_path(folder / "both.pem")
    authority.issue_cert("127.0.0.1").private_key_pem.write_to_path(folder / "other_key.pem")
    rsa = authority.issue_cert("127.0.0.1", key_type=trustme.KeyType.RSA)
    rsa.private_key_and_cert_chain_pem.write_to_path(folder / "rsa.pem")
    (folder / "token").write_text(TOKEN + "\n")
    (folder / "token").chmod(0o600)
    return folder


@pytest.fixture
def lock(papers: Path) -> Lock:
    return Lock(hashed(TOKEN, "test"), tls_context(papers / "certificate.pem", papers / "key.pem"))


@pytest.fixture(autouse=True)
def _no_token_of_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TTSCOMPILE_TOKEN", raising=False)


def test_a_client_with_the_token_and_the_authority_drives_the_robot(lock: Lock, papers: Path, audit: Any) -> None:
    with serving(lock=lock) as url:
        assert url.startswith("wss://")
        with connected(url, token=TOKEN, ca=str(papers / "ca.pem")) as call:
            assert call._socket.version() == "TLSv1.3"
            now = call("info")["time"]
            for t in (now - 0.05, now):  # a window
                assert call("observe", obs={"obs": [7.0, 0.0]}, t=t) == {}
            assert call("action", timeout=2.0)["action"] == [7.0, 7.0, 7.0]
            call.close()
        came, left = audit(2)
    assert (came["event"], came["status"], came["tls"]) == ("let in", 101, "TLSv1.3")
    assert (left["event"], left["requests"], left["from"]) == ("left", 4, came["from"])
    assert TOKEN not in str(audit())
    assert came["from"].startswith("127.0.0.1:") and came["connection"] == left["connection"] == 1


def test_who_is_no_client_of_tls_is_refused_and_written_down(lock: Lock, papers: Path, audit: Any) -> None:
    with serving(lock=lock) as url:
        for authority in ("other_ca.pem", None):
            with pytest.raises(ssl.SSLCertVerificationError):
                Client(url, token=TOKEN, ca=authority and str(papers / authority))
        with raw(url) as sock:  # the handshake in the clear
            sock.sendall(handshake(f"Authorization: Bearer {TOKEN}"))
            assert b"101" not in read_all(sock)
        old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        old.load_verify_locations(papers / "ca.pem")
        with pytest.warns(DeprecationWarning, match="TLSv1_1"):
            old.maximum_version = ssl.TLSVersion.TLSv1_1
        with raw(url) as sock, pytest.raises((ssl.SSLError, ConnectionError)):
            old.wrap_socket(sock, server_hostname="127.0.0.1")
        lines = audit(4)
        still_serves(url, token=TOKEN, ca=str(papers / "ca.pem"))
    assert [(line["event"], line["why"]) for line in lines[:4]] == 4 * [("refused", "it did not finish its handshake")]


@pytest.mark.parametrize("ciphers", ["eNULL:aNULL:@SECLEVEL=0", "AES128-SHA:AES256-SHA:@SECLEVEL=0"])
def test_nothing_weaker_than_tls_is_agreed_on(ciphers: str, papers: Path) -> None:
    """Without a cipher or a certificate, or without a key of the moment; a context that is not ours agrees on them."""
    weak, careless = weakened(papers, ciphers)
    assert agreed(weak, careless) in {name["name"] for name in careless.get_ciphers()}
    with serving(lock=Lock(hashed(TOKEN, "test"), tls_context(papers / "rsa.pem"))) as url:
        with raw(url) as sock, pytest.raises((ssl.SSLError, ConnectionError)):
            weak.wrap_socket(sock, server_hostname="127.0.0.1")
        still_serves(url, token=TOKEN, ca=str(papers / "ca.pem"))


@pytest.mark.parametrize("tls", [False, True])
def test_a_client_is_not_talked_down(tls: bool, papers: Path) -> None:
    """Somebody on the way answers in the clear, or has nothing better than TLS 1.1: no token is sent."""
    heard = list[bytes]()
    old = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    old.load_cert_chain(papers / "both.pem")
    old.set_ciphers("ALL:@SECLEVEL=0")
    with pytest.warns(DeprecationWarning, match="TLSv1_1"):
        old.maximum_version = ssl.TLSVersion.TLSv1_1

    def answer(listening: socket.socket) -> None:
        sock, _ = listening.accept()
        with sock, suppress(OSError):
            if tls:
                sock = old.wrap_socket(sock, server_side=True)
            heard.append(sock.recv(65536))
            sock.sendall(b"HTTP/1.1 101 Switching Protocols\r\n\r\n")

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = Thread(target=answer, args=(listening,))
        thread.start()
        with pytest.raises(ssl.SSLError):
            Client(f"wss://127.0.0.1:{listening.getsockname()[1]}/", token=TOKEN, ca=str(papers / "ca.pem"))
        thread.join(10)
    assert not any(TOKEN.encode() in each for each in heard)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ([f"Authorization: Bearer {TOKEN}"], 101),
        ([f"authorization: bearer  {TOKEN}"], 101),
        ([], 401),
        ([f"Authorization: Bearer {OTHER}"], 401),
        ([f"Authorization: Bearer {TOKEN[:-1]}"], 401),
        ([f"Authorization: Bearer {TOKEN}{TOKEN}"], 401),
        ([f"Authorization: Basic {TOKEN}"], 401),
        (["Authorization: Bearer "], 401),
        (["Authorization: Bearer \xff\xfe"], 401),
        (2 * [f"Authorization: Bearer {TOKEN}"], 401),
        ([f"Authorization: Bearer {TOKEN}", "Origin: http://example.org"], 403),
    ],
)
def test_only_the_token_opens(headers: list[str], status: int, audit: Any) -> None:
    with serving(lock=Lock(hashed(TOKEN, "test"))) as url, raw(url) as sock:
        sock.sendall(handshake(*headers))
        answer = read_all(sock)
        assert f" {status} ".encode() in answer.split(b"\r\n")[0]
        assert (b"WWW-Authenticate: Bearer" in answer) == (status == 401)
        assert audit(1)[0]["status"] == status
        assert TOKEN[:-1] not in str(audit())
        assert audit(1)[0]["event"] == ("let in" if status == 101 else "refused")


def test_tokens_are_compared_in_constant_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """By their hashes, so that neither the place of a difference nor the length can be measured; and none is kept."""
    compared: list[tuple[bytes, bytes]] = []
    compare = hmac.compare_digest

    def noted(a: bytes, b: bytes) -> bool:
        compared.append((a, b))
        return compare(a, b)

    monkeypatch.setattr(hmac, "compare_digest", noted)
    lock = Lock(hashed(TOKEN, "test"))
    assert [lock.opens(f"Bearer {each}") for each in (TOKEN, OTHER, "a")] == [True, False, False]
    assert [len(each) for pair in compared for each in pair] == 6 * [32]
    assert TOKEN not in repr(vars(lock)) and "token_hash" not in repr(lock)


@pytest.mark.parametrize("token", ["", "short", "x" * 21, "a token of 22 letters..", "x" * 30 + "\n" + "y", "ü" * 30])
def test_what_is_no_token_is_refused_and_not_shown(token: str) -> None:
    with pytest.raises(ExecutorError, match="^where: expected at least 22 of the characters") as caught:
        hashed(token, "where")
    assert not token or token not in str(caught.value)


def test_a_token_file_is_a_small_text(tmp_path: Path) -> None:
    (tmp_path / "token").write_bytes(b"\xff" * 30)
    (tmp_path / "large").write_text("x" * 4097)
    os.mkfifo(tmp_path / "pipe")
    for name, why in (
        ("token", "it is no text"),
        ("large", "has more than 4096 bytes"),
        ("pipe", "found a pipe"),
        ("none", "does not exist"),
    ):
        with pytest.raises(ExecutorError, match=why):
            read_token(tmp_path / name)


def test_a_certificate_that_cannot_be_used_is_told(papers: Path, tmp_path: Path) -> None:
    assert tls_context(papers / "both.pem").minimum_version == ssl.TLSVersion.TLSv1_2
    locked = tmp_path / "locked.pem"
    command = ["openssl", "ec", "-aes128", "-passout", "pass:secret", "-in", papers / "key.pem", "-out", locked]
    subprocess.run(list(map(str, command)), check=True, capture_output=True)
    for certificate, key in (
        (papers / "certificate.pem", None),
        (papers / "certificate.pem", papers / "other_key.pem"),
        (papers / "certificate.pem", locked),  # it does not ask on the terminal
        (papers / "token", papers / "key.pem"),
    ):
        with pytest.raises(ExecutorError, match="expected a certificate and its private key without a password"):
            tls_context(certificate, key)


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "192.168.1.5", "::ffff:127.0.0.1", "fe80::1%eth0"])
def test_nobody_listens_beyond_the_machine_without_a_lock(address: str, lock: Lock) -> None:
    open_to_all, token, tls = Lock(), replace(lock, tls=None), replace(lock, token_hash=None)
    for each, lacks in ((open_to_all, "no token and no certificate"), (token, "no certificate"), (tls, "no token")):
        with pytest.raises(ExecutorError, match=f"and the server has {lacks}: "):
            each.require(address)
        replace(each, insecure=True).require(address)
        each.require("127.0.0.1")
        each.require("::1")
    lock.require(address)


@pytest.mark.parametrize("host", ["0.0.0.0", "a-name"])
def test_the_server_itself_refuses_to(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the address that its socket has, whatever name that was asked for by."""
    look_up = socket.getaddrinfo
    monkeypatch.setattr(socket, "getaddrinfo", lambda _, *more, **extra: look_up("0.0.0.0", *more, **extra))
    stop = asyncio.Event()
    stop.set()  # a server that listens all the same ends at once
    with (
        AsyncExecutor(Quick(FakeClock()), 20, latencies={"dense": 0.01}) as executor,
        pytest.raises(ExecutorError, match=r"^0.0.0.0 may be reached from other machines"),
    ):
        asyncio.run(ExecutorServer(executor).run(host, 0, stop))


def test_whoever_fails_often_is_cut_off_and_the_others_go_on(lock: Lock, audit: Any) -> None:
    with (
        serving(limits=replace(LIMITS, refusals_per_minute=3), lock=replace(lock, tls=None)) as url,
        connected(url, token=TOKEN) as call,
    ):
        for _ in range(3):
            with pytest.raises(ConnectionError, match="401"):
                Client(url, token=OTHER)
        for _ in range(5):
            with raw(url) as sock:
                assert read_all(sock) == b""  # before a byte was read
        assert call("info")["n_obs_steps"] == 2
    assert [line["event"] for line in audit()] == ["let in", *3 * ["refused"], "cut off", "left"]


def test_silent_connections_hold_few_places(lock: Lock, papers: Path) -> None:
    """They cannot take all file descriptors, nor the place of a client."""
    with serving(limits=replace(LIMITS, handshakes_per_address=3, handshake_timeout=1.0), lock=lock) as url:
        silent = [raw(url) for _ in range(3)]
        with raw(url) as fourth:
            start = time.monotonic()
            assert read_all(fourth) == b""
            assert time.monotonic() - start < 0.9
        for sock in silent:
            read_all(sock)  # until their time is over
            sock.close()
        still_serves(url, token=TOKEN, ca=str(papers / "ca.pem"))


def test_clients_of_one_address_are_limited(audit: Any) -> None:
    with serving(limits=replace(LIMITS, clients_per_address=2)) as url, connected(url), connected(url):
        with raw(url) as sock:
            sock.sendall(handshake())
            assert b"2 clients of this address are connected" in read_all(sock)
        assert [line["event"] for line in audit(3)] == ["let in", "let in", "refused"]


def test_a_client_that_asks_too_often_waits_and_the_others_do_not() -> None:
    limits = replace(LIMITS, requests_per_second=50.0)
    frame = struct.pack("!BB", 0x81, 0x80 | 17) + b"\0\0\0\0" + b'{"method":"info"}'
    with serving(limits=limits) as url, connected(url) as call, connected(url) as other:
        start = time.monotonic()
        call._socket.sendall(100 * frame)
        for _ in range(50):
            call._receive()
        before, took = time.monotonic(), []
        for _ in range(5):
            sent = time.monotonic()
            other("info")
            took.append(time.monotonic() - sent)
        for _ in range(50):
            call._receive()
        end = time.monotonic()
    assert end - start >= 0.95  # the second fifty come one by one
    assert sorted(took)[2] < (end - before) / 4


def test_the_client_sends_no_token_in_the_clear() -> None:
    with pytest.raises(ConnectionError, match="could be read on the way"):
        Client("ws://192.0.2.1:8765/", token=TOKEN)
    assert [client.on_this_machine(host) for host in ("127.9.9.9", "::1", "localhost", "example.org")] == [
        True,
        True,
        True,
        False,
    ]


@pytest.fixture
def command(toy_compiled: Path) -> list[str]:
    return ["serve", str(toy_compiled), "--control-hz", "10", "--port", "0", "--margin-ticks", "0"]


@pytest.mark.parametrize(
    ("more", "token", "told"),
    [
        (["--host", "0.0.0.0"], None, "the server has no token and no certificate"),
        (["--host", "0.0.0.0", "--token-file", "token"], None, "the server has no certificate"),
        (["--host", "::", "--tls", "both.pem"], None, "the server has no token"),
        (["--token-file", "token"], TOKEN, "there are two tokens, in TTSCOMPILE_TOKEN and in "),
        ([], "", "the environment's TTSCOMPILE_TOKEN: expected at least 22"),
        ([], OTHER[:9], "the environment's TTSCOMPILE_TOKEN: expected at least 22"),
        (["--tls", "certificate.pem", "other_key.pem"], None, "expected a certificate and its"),
        (["--tls", "certificate.pem", "key.pem", "ca.pem"], None, "its key if that is in another file; found 3"),
    ],
)
def test_the_command_refuses_before_anything_is_loaded(
    more: list[str], token: str | None, told: str, command: list[str], papers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ttscompile.load", lambda *_, **__: pytest.fail("it was loaded"))
    monkeypatch.chdir(papers)
    if token is not None:
        monkeypatch.setenv("TTSCOMPILE_TOKEN", token)
    result = CliRunner().invoke(main, [*command, *more])
    assert (result.exit_code, result.stdout) == (2, "")
    assert told in result.stderr and len(result.stderr.split("\n\n")[-1].splitlines()) <= 3
    assert not token or token not in result.stderr


def test_no_option_takes_a_token() -> None:
    """The list of processes shows command lines to every user of the machine."""
    named = {name: option for option in main.commands["serve"].params for name in option.opts if "token" in name}
    assert sorted(named) == ["--token-file", "--tokenizer"]
    assert all(isinstance(option.type, PathName) for option in named.values())


@pytest.mark.slow
def test_the_command_lets_the_example_client_in(command: list[str], papers: Path) -> None:
    """On every address of the machine; the token is in nothing that is written."""
    words = [sys.executable, "-P", "-m", "ttscompile", *command, "--host", "0.0.0.0", "--token-file", papers / "token"]
    words += ["--tls", papers / "certificate.pem", papers / "key.pem"]
    with subprocess.Popen(list(map(str, words)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None and server.stderr is not None
            first = server.stdout.readline()
            assert first, server.stderr.read()
            url = json.loads(first)["url"]
            assert url.startswith("wss://0.0.0.0:")
            run = [sys.executable, "-I", str(CLIENT), url.replace("0.0.0.0", "127.0.0.1"), "--seconds", "0.5"]
            run += ["--ca", str(papers / "ca.pem")]
            let_in = subprocess.run(
                [*run, "--token-file", papers / "token"], capture_output=True, text=True, timeout=60
            )
            refused = subprocess.run(run, capture_output=True, text=True, timeout=60)
        finally:
            os.kill(server.pid, signal.SIGINT)
        out, err = server.communicate(timeout=30)
    assert server.returncode == 0
    assert let_in.returncode == 0, let_in.stderr
    assert json.loads(let_in.stdout.splitlines()[-1])["frames"] == 5
    assert (refused.returncode, refused.stdout) == (1, "") and "401" in refused.stderr
    assert [json.loads(line)["event"] for line in err.splitlines()] == ["let in", "left", "refused"]
    assert TOKEN not in first + out + err
