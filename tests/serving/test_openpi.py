"""The server of openpi's clients: what it answers, and whom it lets in."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import ttscompile
from tests.serving.serving import LIMITS, handshake, listening, raw, wait_until
from tests.serving.watching import figures, get
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.cli import main
from ttscompile.core.spec import Instruction, ObservationSpec
from ttscompile.errors import IllegalPlanError
from ttscompile.runtimes.arrays import check_observation, read_observation
from ttscompile.serving.admission import ServerLimits
from ttscompile.serving.lock import Lock, hashed
from ttscompile.serving.openpi import OpenPiServer

from .openpi_clients import (
    GOOD,
    ConnectionClosed,
    InvalidStatus,
    actions,
    ask,
    at_once,
    client,
    packed,
    raw_array,
    received,
    serving,
)

TOKEN = "a-token-of-these-tests-alone"
WORDS = {
    "obs": ObservationSpec((2,)),
    "tokens": ObservationSpec((4,), dtype="int64", window=False),
    "mask": ObservationSpec((4,), dtype="bool", window=False),
}


class Checked:
    """A policy that checks what it is given as any does, keeps it, and does nothing else."""

    def __init__(self, artifact: Artifact) -> None:
        self.specs = artifact.manifest.spec.observations
        self.info = SimpleNamespace(default_plan="dense")
        self.seen: list[Mapping[str, Any]] = []
        self.resets, self.tokenizes = 0, False
        self.may = threading.Event()
        self.may.set()

    def reset(self) -> None:
        self.resets += 1

    def predict_action(self, obs: Mapping[str, Any], plan: str) -> dict[str, Any]:
        assert plan == "dense"
        assert self.may.wait(5)
        self.seen.append(obs)
        if self.tokenizes:
            obs = {"obs": obs["obs"], "tokens": np.ones((1, 4), np.int64), "mask": np.ones((1, 4), np.bool_)}
        check_observation(read_observation(obs, self.specs)[0], self.specs)
        return {"action": np.zeros((1, 2, 3), np.float32)}


@contextmanager
def checking(planned: Path, limits: ServerLimits = LIMITS, **changes: Any) -> Iterator[tuple[str, Checked]]:
    """A server of such a policy with another specification."""
    artifact = load_artifact(planned)
    manifest = replace(artifact.manifest, spec=replace(artifact.manifest.spec, **changes))
    artifact = replace(artifact, manifest=manifest)
    policy: Any = Checked(artifact)
    with listening(lambda: OpenPiServer(artifact, policy, limits)) as url:
        yield url, policy


def test_the_client_is_told_what_the_policy_is_and_answered_as_by_the_policy(planned: Path) -> None:
    policy = ttscompile.load(planned, seed=5)
    with serving(planned, None) as url, client(url) as connection:
        told = received(connection)
        assert told["observation"] == {"obs": {"shape": [2], "dtype": "float32"}}
        assert (told["plan"], told["identity"], told["idle_timeout"]) == ("evenly", policy.info.identity, 3600)
        for _ in range(2):  # each an episode, with other noise
            answer = ask(connection, packed({"obs": GOOD}))
            policy.reset()
            expected = policy.predict_action({"obs": GOOD[None]})["action"][0]
            assert actions(answer).dtype == np.float32
            np.testing.assert_array_equal(actions(answer), expected)
            assert list(expected.shape) == told["action"]["shape"]
            assert answer["server_timing"]["infer_ms"] > 0


def test_the_axes_of_batch_and_of_one_frame_are_added_and_scalars_are_numbers(planned: Path) -> None:
    specs = {
        "state": ObservationSpec((1, 3)),
        "grip": ObservationSpec((1, 1)),
        "speed": ObservationSpec((1,), window=False),
        "open": ObservationSpec((1,), dtype="bool", window=False),
        "two": ObservationSpec((2, 3)),
    }
    state = np.arange(3, dtype=np.float32)
    rest = {"two": np.zeros((2, 3), np.float32), "open": np.array([True])}
    with checking(planned, observations=specs) as (url, policy), client(url) as connection:
        connection.recv(10)
        for obs in (
            {"state": state, "grip": np.float32(0.5), "speed": 2, **rest},
            {"state": state[None], "grip": np.array(0.5, np.float32), "speed": [2.0], **rest, "open": np.bool_(True)},
        ):
            assert actions(ask(connection, packed(obs))).shape == (2, 3)
        for seen in policy.seen:
            assert {key: value.shape for key, value in seen.items()} == {
                key: (1, *spec.shape) for key, spec in specs.items()
            }
            assert (seen["grip"].item(), seen["speed"].item(), seen["open"].item()) == (0.5, 2.0, True)
        assert policy.resets == 2
        one = ask(connection, packed({**obs, "two": state}))
        assert "ObservationError: observation 'two' has the wrong shape: expected float32 [B, 2, 3]" in one


def test_a_picture_of_bytes_is_refused_with_advice(planned: Path) -> None:
    specs = {"camera": ObservationSpec((1, 3, 8, 9), bounds=(0.0, 1.0))}
    with checking(planned, observations=specs) as (url, _), client(url) as connection:
        connection.recv(10)
        picture = np.zeros((8, 9, 3), np.uint8)
        refused = ask(connection, packed({"camera": picture}))
        assert "Divide by 255, channels first" in refused
        assert "np.moveaxis(image, -1, -3)" in refused
        right = np.moveaxis(picture, -1, 0).astype(np.float32) / 255
        assert actions(ask(connection, packed({"camera": right}))).shape == (2, 3)


def test_the_prompt_is_the_task_where_the_policy_has_a_tokenizer(planned: Path) -> None:
    how: dict[str, Any] = {"observations": WORDS, "instruction": Instruction("tokens", "mask", new_line=False)}
    with checking(planned, replace(LIMITS, message_bytes=8192), **how) as (url, policy), client(url) as connection:
        connection.recv(10)
        refused = ask(connection, packed({"obs": GOOD, "prompt": "pick"}))
        assert "missing: ['mask', 'tokens']" in refused
        assert "load with tokenizer=PATH (serve: --tokenizer), or compile it in" in refused
        policy.tokenizes = True
        assert "actions" in ask(connection, packed({"obs": GOOD, "prompt": "pick"}))
        assert policy.seen[-1]["task"] == "pick"
        long = ask(connection, packed({"obs": GOOD, "prompt": "a" * 4097}))
        assert long == "ProtocolError: a task has at most 4096 characters; found 4097."
        several = ask(connection, packed({"obs": GOOD, "prompt": ["a" * 2000, "b"]}))
        assert several == "ProtocolError: a task is a text; found list."


def test_the_prompt_may_be_the_task_that_is_compiled_in_and_no_other(planned: Path) -> None:
    with checking(planned, source={"task": "pick"}) as (url, policy), client(url) as connection:
        connection.recv(10)
        assert "actions" in ask(connection, packed({"obs": GOOD, "prompt": "pick"}))
        assert policy.seen[-1].keys() == {"obs"}
        assert "unexpected: ['task']" in ask(connection, packed({"obs": GOOD, "prompt": "place"}))


def test_a_byte_of_a_bool_is_true_or_false(planned: Path) -> None:
    specs = {"open": ObservationSpec((3,), dtype="bool", window=False)}
    with checking(planned, observations=specs) as (url, policy), client(url) as connection:
        connection.recv(10)
        assert "actions" in ask(connection, packed({"open": raw_array(b"\0\1\7", "|b1", [3])}))
        assert policy.seen[0]["open"].view(np.uint8).tolist() == [[0, 1, 1]]


def test_a_message_beyond_the_limit_and_a_silent_client_end_their_own_connection(planned: Path) -> None:
    with serving(planned) as url, client(url) as other:
        other.recv(10)
        with client(url) as connection:
            connection.recv(10)
            with pytest.raises(ConnectionClosed, match="1009"):
                ask(connection, packed({"obs": np.zeros(2000, np.float32)}))
        assert "actions" in ask(other, packed({"obs": GOOD}))
        with pytest.raises(ConnectionClosed, match="1008.*no complete request for 0.6 s"):
            other.recv(10)


def test_calls_are_made_one_by_one_and_a_client_that_vanishes_is_not_computed_for(planned: Path) -> None:
    with checking(planned, at_once(4)) as (url, policy), ExitStack() as stack:
        policy.may.clear()
        clients = [stack.enter_context(client(url)) for _ in range(3)]
        for number, each in enumerate(clients):
            each.recv(10)
            each.send(packed({"obs": GOOD + number}))
            wait_until(lambda n=number: figures(get(url, "/metrics")[1])["ttscompile_waiting"] == n + 1)
        assert policy.resets == 1
        clients[1].close()
        wait_until(lambda: figures(get(url, "/metrics")[1])["ttscompile_waiting"] == 2)
        policy.may.set()
        for each in (clients[0], clients[2]):
            assert "actions" in received(each)
        assert [seen["obs"][0, 0] for seen in policy.seen] == [1.0, 3.0]


def test_who_does_not_answer_pings_is_found_long_before_the_idle_timeout(planned: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(OpenPiServer, "ping_interval", 0.02)
    with serving(planned, None) as url, raw(url) as sock:
        sock.sendall(handshake())
        told = b""
        while b"\x89\x04" not in told.rpartition(b"\r\n\r\n")[2]:  # the head of a ping
            told += sock.recv(4096)


def test_the_lock_takes_the_token_in_either_form(planned: Path) -> None:
    with serving(planned, lock=Lock(hashed(TOKEN, "test"))) as url:
        for key, form in ((None, ""), (TOKEN + "x", "Api-Key"), (TOKEN, "Basic"), (f"Bearer {TOKEN}", "Api-Key")):
            with pytest.raises(InvalidStatus, match="401"), client(url, key, form):
                pass
        assert get(url, "/metrics")[0] == 401
        for form in ("Api-Key", "Bearer", "api-key"):
            with client(url, TOKEN, form) as connection:
                connection.recv(10)
                assert "actions" in ask(connection, packed({"obs": GOOD}))


def test_one_client_more_than_there_may_be_is_refused(planned: Path) -> None:
    with serving(planned, at_once(1)) as url, client(url) as connection:
        connection.recv(10)
        with pytest.raises(InvalidStatus, match="503"), client(url):
            pass
        assert "actions" in ask(connection, packed({"obs": GOOD}))


def test_it_says_how_it_is_and_what_it_did(planned: Path) -> None:
    with serving(planned) as url, client(url) as connection:
        connection.recv(10)
        for message in (packed({"obs": GOOD}), packed({"obs": GOOD}), b"\xc1", packed({})):
            ask(connection, message)
        assert get(url, "/health") == (200, "ok\n")
        shown = figures(get(url, "/metrics")[1])
    assert shown['ttscompile_requests_total{method="infer",outcome="ok"}'] == 2
    assert shown['ttscompile_requests_total{method="infer",outcome="ObservationError"}'] == 1
    assert shown['ttscompile_requests_total{method="unknown",outcome="ProtocolError"}'] == 1
    assert shown['ttscompile_streams_total{plan="evenly"}'] == 2
    assert shown["ttscompile_clients"] == 1


def test_a_plan_that_reads_the_call_before_is_refused(planned: Path) -> None:
    artifact = load_artifact(planned)
    with pytest.raises(IllegalPlanError, match="another robot's"):
        OpenPiServer(artifact, ttscompile.load(planned, plan="memory"))


def test_a_plan_may_be_in_another_precision(planned: Path) -> None:
    artifact, policy = load_artifact(planned), ttscompile.load(planned, plan="evenly@fp32")
    with listening(lambda: OpenPiServer(artifact, policy, LIMITS)) as url, client(url) as connection:
        assert received(connection)["plan"] == "evenly@fp32"
        assert "actions" in ask(connection, packed({"obs": GOOD}))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--plan", "memory"), "another robot's"),
        (("--host", "0.0.0.0"), "no token and no certificate"),
        (("--copies", "1"), "or --copies N or --openpi to answer many"),
        (("--plan", "dense", "--plan", "evenly"), "take one --plan"),
        (("--policy-hz", "10"), "--policy-hz is for --control-hz: give it too"),
        (("--ray", "local"), "--ray is for --copies: give it too"),
    ],
)
def test_what_cannot_be_is_one_error(planned: Path, options: tuple[str, ...], message: str) -> None:
    result = CliRunner().invoke(main, ["serve", str(planned), "--openpi", "--port", "0", *options])
    assert (result.exit_code, result.stdout) == (2, ""), result.output
    assert message in " ".join(result.stderr.split())


def test_without_msgpack_it_says_what_to_install(planned: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "msgpack", None)
    result = CliRunner().invoke(main, ["serve", str(planned), "--openpi", "--port", "0"])
    assert (result.exit_code, result.stdout) == (2, "")
    assert "needs msgpack" in result.stderr
    assert "pip install 'ttscompile[serve]'" in " ".join(result.stderr.split())
