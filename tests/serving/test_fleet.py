"""The server of a fleet, with copies that are scripted: what it lets through, and what it tells."""

import asyncio
import base64
import importlib.util
import shutil
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.plans import store_schedules
from tests.serving.serving import LIMITS, Client, ServerError, connected, listening, vanish, wait_until
from tests.serving.watching import figures, get
from tests.word_tokenizer import write_tokenizer
from ttscompile.artifact.load import load_artifact
from ttscompile.core.coercion import Array
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.spec import Instruction, ObservationSpec
from ttscompile.core.values import fitted
from ttscompile.errors import ClusterError, IllegalPlanError, NonFiniteActionsError
from ttscompile.runtimes.instruct import instruct_of
from ttscompile.serving.fleet import Answered, FleetServer, Plans
from ttscompile.serving.lock import Lock, hashed

if importlib.util.find_spec("websockets") is None:
    pytest.skip("NO FLEET TESTS: websockets is not installed; pip install 'ttscompile[serve]'", allow_module_level=True)

GOOD = {"obs": [1.0, 2.0]}


class Scripted:
    """Copies that answer with the observation, once they may; an observation below zero is trouble."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.given: list[Mapping[str, Array]] = []
        self.may = threading.Event()
        self.may.set()
        self.state = ""

    async def predict(self, plan: str, obs: Mapping[str, Array]) -> Answered:
        self.asked.append(plan)
        self.given.append(obs)
        while not self.may.is_set():
            await asyncio.sleep(0.001)
        if obs["obs"][0] < -1:
            raise ClusterError("a copy failed: scripted. Ask again.")
        if obs["obs"][0] < 0:
            raise NonFiniteActionsError("scripted")
        return Answered(np.stack([obs["obs"]] * 2), first=len(self.asked) % 2 == 1)

    async def trouble(self) -> str:
        return self.state


@pytest.fixture
def copies() -> Scripted:
    return Scripted()


def fleet(planned: Path, copies: Scripted, lock: Lock | None = None, **options: Any) -> Any:
    artifact = load_artifact(planned)
    return listening(lambda: FleetServer(artifact, copies, lock=lock, **{"limits": LIMITS, **options}), lock)


def test_a_robot_asks_and_is_answered(planned: Path, copies: Scripted) -> None:
    with fleet(planned, copies) as url, connected(url) as call:
        told = call("info")
        assert told["observation"] == {"obs": {"shape": [2], "dtype": "float32"}}
        assert (told["plans"], told["default_plan"]) == (["dense", "evenly"], "evenly")
        assert told["identity"] == load_artifact(planned).manifest.identity
        assert call("predict", obs=GOOD) == {"action": [[1.0, 2.0], [1.0, 2.0]]}
        call("predict", obs=GOOD, plan="dense")
    assert copies.asked == ["evenly", "dense"]


@pytest.mark.parametrize(
    ("params", "kind", "message"),
    [
        ({"obs": {"obs": [1.0, 2.0, 3.0]}}, "ObservationError", r"must be float32 \[2\].*; found float32 \[3\]"),
        ({"obs": {"obs": [1.0, None]}}, "ProtocolError", "numbers"),
        ({"obs": {"obs": [1.0, 1e300]}}, "ObservationError", "finite"),
        ({"obs": {}}, "ObservationError", r"expected an observation of \['obs'\]; found \[\]"),
        ({"obs": {**GOOD, "more": [1.0]}}, "ObservationError", "more"),
        ({}, "ProtocolError", "predict needs obs"),
        ({"obs": GOOD, "plan": "memory"}, "IllegalPlanError", "another robot's"),
        ({"obs": GOOD, "plan": "nothing"}, "IllegalPlanError", r"expected one of \['dense', 'evenly'\]"),
        ({"obs": GOOD, "plan": 3}, "ProtocolError", "plan is the name of one"),
        ({"obs": GOOD, "seed": 3}, "ProtocolError", "predict takes"),
        ({"obs": {"obs": [-1.0, 0.0]}}, "NonFiniteActionsError", "scripted"),
        ({"obs": {"obs": [-2.0, 0.0]}}, "ClusterError", "Ask again"),
    ],
)
def test_what_is_wrong_is_told_and_the_next_request_is_answered(
    planned: Path, copies: Scripted, params: dict[str, Any], kind: str, message: str
) -> None:
    with fleet(planned, copies) as url, connected(url) as call:
        with pytest.raises(ServerError, match=f"(?s){kind}: .*{message}"):
            call("predict", **params)
        assert len(call("predict", obs=GOOD)["action"]) == 2


def test_robots_send_their_instruction_as_text_where_the_fleet_has_a_tokenizer(
    planned: Path, copies: Scripted, tmp_path: Path
) -> None:
    """The server makes the tokens, so that copies get them whoever asks."""
    artifact, told = load_artifact(planned), Instruction("tokens", "mask", new_line=False)
    words = {"tokens": ObservationSpec((3,), dtype="int64", window=False)}
    words["mask"] = ObservationSpec((3,), dtype="bool", window=False)
    spec = replace(artifact.manifest.spec, observations={**artifact.manifest.spec.observations, **words})
    spec_told = replace(spec, instruction=told)
    read = replace(artifact, manifest=replace(artifact.manifest, spec=spec_told))
    tokenizer = write_tokenizer(tmp_path / "language", {"?": 0, "push": 1, "left": 2})

    def served(**options: Any) -> Any:
        return listening(lambda: FleetServer(read, copies, limits=replace(LIMITS, message_bytes=8192), **options))

    with served(instruct=instruct_of(read, tokenizer)) as url, connected(url) as call:
        assert call("predict", obs={**GOOD, "task": "push left"})["action"]
        assert copies.given[-1]["tokens"].tolist() == [1, 2, 0]
        assert copies.given[-1]["mask"].tolist() == [True, True, False]
        call("predict", obs={**GOOD, "tokens": [2, 0, 0], "mask": [True, False, False]})
        assert copies.given[-1]["tokens"].tolist() == [2, 0, 0]
        for task, why in (("a" * 4097, "at most 4096 characters"), (["push"], "a task is a text; found list")):
            with pytest.raises(ServerError, match=f"ProtocolError: .*{why}"):
                call("predict", obs={**GOOD, "task": task})
    with (
        served() as url,
        connected(url) as call,
        pytest.raises(ServerError, match=r"found \['obs', 'task'\]. Text needs a server with a tok"),
    ):
        call("predict", obs={**GOOD, "task": "push left"})


def test_pictures_are_resized_as_by_the_policy_and_bytes_are_refused_with_advice(
    planned: Path, copies: Scripted
) -> None:
    artifact = load_artifact(planned)
    seen = {"obs": ObservationSpec((2,)), "front": ObservationSpec((1, 3, 8, 8), bounds=(0.0, 1.0), fit="start")}
    spec = replace(artifact.manifest.spec, observations=seen)
    artifact = replace(artifact, manifest=replace(artifact.manifest, spec=spec))
    picture, limits = np.random.default_rng(0).random((1, 3, 4, 16), np.float32), replace(LIMITS, message_bytes=8192)
    with listening(lambda: FleetServer(artifact, copies, limits=limits)) as url, connected(url) as call:
        assert call("predict", obs={**GOOD, "front": picture.tolist()})["action"]
        np.testing.assert_array_equal(copies.given[-1]["front"], fitted(picture, seen["front"]))
        image = np.zeros((1, 8, 8, 3), np.uint8)
        packed = {"dtype": "uint8", "shape": image.shape, "base64": base64.b64encode(image.tobytes()).decode()}
        with pytest.raises(ServerError, match=r"Divide by 255, channels first.*np\.moveaxis\(image, -1, -3\)"):
            call("predict", obs={**GOOD, "front": packed})
    assert len(copies.given) == 1


def test_more_requests_than_may_be_under_way_are_refused_at_once(planned: Path, copies: Scripted) -> None:
    copies.may.clear()
    with fleet(planned, copies, waiting=2) as url:
        waiting = [Client(url, timeout=5.0) for _ in range(2)]
        threads = [threading.Thread(target=call, args=("predict",), kwargs={"obs": GOOD}) for call in waiting]
        for thread in threads:
            thread.start()
        wait_until(lambda: len(copies.asked) == 2)
        with connected(url) as call:
            with pytest.raises(ServerError, match="OverloadedError: 2 requests are under way"):
                call("predict", obs=GOOD)
            assert figures(get(url, "/metrics")[1])["ttscompile_waiting"] == 2
            copies.may.set()
            for thread in threads:
                thread.join(5)
            assert call("predict", obs=GOOD)["action"]
        for client in waiting:
            vanish(client)
    assert len(copies.asked) == 3


def test_a_robot_that_vanishes_gives_its_place_back(planned: Path, copies: Scripted) -> None:
    copies.may.clear()
    with fleet(planned, copies, waiting=1) as url:
        gone = Client(url, timeout=5.0)
        gone._send(1, b'{"method": "predict", "obs": {"obs": [1.0, 2.0]}}')
        wait_until(lambda: len(copies.asked) == 1)
        vanish(gone)
        wait_until(lambda: figures(get(url, "/metrics")[1])["ttscompile_waiting"] == 0)
        copies.may.set()
        with connected(url) as call:
            assert call("predict", obs=GOOD)["action"]


def test_an_answer_that_never_comes_is_a_missed_deadline(planned: Path, copies: Scripted) -> None:
    copies.may.clear()
    with fleet(planned, copies, limits=replace(LIMITS, action_timeout=0.05)) as url, connected(url) as call:
        with pytest.raises(ServerError, match=r"DeadlineMissedError: no copy answered within 0\.05 s"):
            call("predict", obs=GOOD)
        copies.may.set()
        assert call("predict", obs=GOOD)["action"]


def test_it_says_how_it_is_and_what_it_did(planned: Path, copies: Scripted) -> None:
    with fleet(planned, copies) as url, connected(url) as call:
        for plan in ("dense", "dense", "evenly"):
            call("predict", obs=GOOD, plan=plan)
        with pytest.raises(ServerError):
            call("predict", obs={"obs": [-2.0, 0.0]})
        assert get(url, "/health") == (200, "ok\n")
        copies.state = "the copies are DEPLOYING"
        assert get(url, "/health") == (503, "the copies are DEPLOYING\n")
        shown = figures(get(url, "/metrics")[1])
    assert shown['ttscompile_streams_total{plan="dense"}'] == 2
    assert shown['ttscompile_batches_total{plan="dense"}'] == 1
    assert shown['ttscompile_streams_total{plan="evenly"}'] == 1
    assert shown['ttscompile_requests_total{method="predict",outcome="ok"}'] == 3
    assert shown['ttscompile_requests_total{method="predict",outcome="ClusterError"}'] == 1
    assert shown["ttscompile_request_seconds_count"] == shown['ttscompile_request_seconds_bucket{le="+Inf"}'] == 4
    assert shown['ttscompile_request_seconds_bucket{le="0.005"}'] <= 4
    assert 0 < shown["ttscompile_request_seconds_sum"] < 4


def test_the_lock_is_that_of_serve(planned: Path, copies: Scripted) -> None:
    token = "a-token-of-these-tests-alone"
    with fleet(planned, copies, Lock(hashed(token, "test"))) as url:
        with pytest.raises(ConnectionError, match="401"):
            Client(url)
        assert get(url, "/metrics")[0] == 401
        with connected(url, token=token) as call:
            assert call("predict", obs=GOOD)["action"]


@pytest.mark.parametrize(("plan", "message"), [("memory", "another robot's"), ("nothing", "expected one of")])
def test_a_plan_that_cannot_run_is_refused_before_it_starts(planned: Path, plan: str, message: str) -> None:
    with pytest.raises(IllegalPlanError, match=message):
        Plans.of(load_artifact(planned), plan)


def test_the_default_may_be_a_plan_in_another_precision(planned: Path, copies: Scripted) -> None:
    with fleet(planned, copies, plan="evenly@fp32") as url, connected(url) as call:
        assert call("info")["plans"] == ["dense", "evenly", "evenly@fp32"]
        for plan in (None, "evenly", "evenly@fp32"):
            call("predict", obs=GOOD, plan=plan)
        with pytest.raises(ServerError, match="IllegalPlanError: plan 'dense@fp32' cannot run here"):
            call("predict", obs=GOOD, plan="dense@fp32")  # each would be opened by every copy
    assert copies.asked == ["evenly@fp32", "evenly", "evenly@fp32"]
    for plan, message in (("memory@fp32", "another robot's"), ("evenly@fp31", "no plan 'evenly@fp31'")):
        with pytest.raises(IllegalPlanError, match=message):
            Plans.of(load_artifact(planned), plan)


def test_a_pruner_that_may_read_the_call_before_is_left_out(toy_compiled: Path, tmp_path: Path) -> None:
    """Each request begins an episode: such a plan would quietly be another one than was calibrated."""
    path = shutil.copytree(toy_compiled, tmp_path / "artifact")
    store_schedules(path, dict(load_artifact(path).pruner), {"evenly": uniform_plan(5, 5, 2)}, "tts", {})
    artifact = load_artifact(path)
    assert Plans.of(artifact, "evenly").names == ("dense", "evenly")
    with pytest.raises(IllegalPlanError, match="another robot's"):
        Plans.of(artifact)
