"""``ttscompile serve --copies``: what it refuses; and, where Ray is installed, copies that answer in batches."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import ttscompile
from tests.serving.serving import Client, ServerError
from tests.serving.watching import figures, get
from ttscompile.cli import main

WRONG = 11, 2
WITHOUT = "NO TESTS OF A FLEET ON RAY: ray or websockets is not installed; pip install 'ttscompile[ray,serve]'"
ray_needed = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None or importlib.util.find_spec("websockets") is None, reason=WITHOUT
)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--host", "0.0.0.0"), "no token and no certificate"),
        (("--plan", "memory"), "another robot's"),
        (("--plan", "nothing"), "expected one of ['dense', 'evenly']"),
        (("--plan", "dense@bf16"), "runtime 'onnxruntime' computes in fp32"),
        (("--plan", "dense@int8"), "the artifact has fp32 alone"),
        (("--copies", "0"), "0 is not in the range"),
        (("--control-hz", "10"), "give --control-hz HZ to drive one robot, or --copies N or --openpi to answer many"),
        (("--margin-ticks", "0"), "--margin-ticks is for --control-hz: give it too"),
        (("--device", "cpu"), "--device is for --control-hz or --openpi: give one of them too"),
        (("--plan", "dense", "--plan", "evenly"), "--copies and --openpi take one --plan"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_starts(
    planned: Path, options: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TTSCOMPILE_TOKEN", raising=False)
    monkeypatch.setitem(sys.modules, "ray", None)
    result = CliRunner().invoke(main, ["serve", str(planned), "--copies", "1", *options])
    assert (result.exit_code, result.stdout) == (2, ""), result.output
    assert message in " ".join(result.stderr.split())


def test_without_ray_it_says_what_to_install(planned: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    result = CliRunner().invoke(main, ["serve", str(planned), "--copies", "1"])
    assert (result.exit_code, result.stdout) == (2, "")
    assert "pip install 'ttscompile[ray,serve]'" in " ".join(result.stderr.split())


def test_a_cluster_that_does_not_start_is_one_error(planned: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray raises a bare Exception where a node takes too long, as on a busy machine."""

    def init(**options: Any) -> None:
        raise Exception("The current node timed out during startup.\nMore.")

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=init, serve=None))
    result = CliRunner().invoke(main, ["serve", str(planned), "--copies", "1", "--port", "0"])
    assert (result.exit_code, result.stdout) == (2, ""), result.output
    assert "no cluster can be reached (The current node timed out during startup.)" in " ".join(result.stderr.split())


def test_ray_does_not_take_sigterm_for_itself(planned: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own handler would end the command with status 15, and without a word."""
    before = signal.getsignal(signal.SIGTERM)

    def init(**options: Any) -> None:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(15))

    def start(**options: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    ray = SimpleNamespace(init=init, serve=SimpleNamespace(start=start, shutdown=lambda: None), shutdown=lambda: None)
    monkeypatch.setitem(sys.modules, "ray", ray)
    try:
        result = CliRunner().invoke(main, ["serve", str(planned), "--copies", "1", "--port", "0"])
    finally:
        signal.signal(signal.SIGTERM, before)
    assert result.exit_code == 143, result.output
    assert result.stderr.strip().endswith("ended by SIGTERM")


@contextmanager
def running(planned: Path, *options: str) -> Iterator[str]:
    """The command, until the block ends; its url."""
    command = [sys.executable, "-m", "ttscompile", "serve", str(planned), "--copies", "1", "--port", "0", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            first = process.stdout.readline()
            assert first, process.communicate()[1]
            yield json.loads(first)["url"]
        finally:
            process.send_signal(signal.SIGTERM)
            out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert out == ""


@pytest.mark.slow
@ray_needed
def test_a_fleet_is_answered_in_batches_of_one_plan(planned: Path) -> None:
    """Twelve robots, half of them with a plan of their own; one sends what only the policy refuses, and fails alone."""
    given = [np.array([i, 0.5 * i], np.float32) for i in range(12)]
    answers, refused = dict[tuple[int, int], Any](), dict[tuple[int, int], str]()

    def robot(i: int, url: str) -> None:
        client, plan = Client(url, timeout=60.0), ("dense" if i % 2 else None)
        for turn in range(4):
            obs = [1e30, 0.0] if (i, turn) == WRONG else given[i].tolist()
            try:
                answers[i, turn] = client("predict", obs={"obs": obs}, plan=plan)["action"]
            except ServerError as error:
                refused[i, turn] = str(error)
        client.close()

    with running(planned) as url:
        assert get(url, "/health") == (200, "ok\n")
        robots = [threading.Thread(target=robot, args=(i, url)) for i in range(12)]
        for each in robots:
            each.start()
        for each in robots:
            each.join(120)
        shown = figures(get(url, "/metrics")[1])
    assert len(answers) == 47
    assert list(refused) == [WRONG]
    assert "ObservationError: observation 'obs' must be between" in refused[WRONG]
    for plan, expected in {"dense": 23, "evenly": 24}.items():
        streams, batches = (shown[f'ttscompile_{what}_total{{plan="{plan}"}}'] for what in ("streams", "batches"))
        assert streams == expected
        assert batches < streams
    info = ttscompile.load(planned).info
    assert all(np.isfinite(each).all() and np.shape(each)[1] == info.action.action_dim for each in answers.values())


@pytest.mark.slow
@ray_needed
def test_a_copy_that_dies_is_replaced_and_the_fleet_is_answered(planned: Path) -> None:
    with running(planned) as url:
        call = Client(url, timeout=60.0)
        assert call("predict", obs={"obs": [1.0, 0.0]})["action"]
        (copy,) = processes("ServeReplica:")
        os.kill(copy, signal.SIGKILL)
        for _ in range(60):
            with suppress(ServerError):  # of the request that the dead copy had, and of those before there is another
                assert call("predict", obs={"obs": [1.0, 0.0]})["action"]
                break
        else:
            raise AssertionError("no copy came back")
        assert processes("ServeReplica:") != [copy]
        call.close()


def processes(name: str) -> list[int]:
    """Processes of this user's that Ray calls so."""
    found = subprocess.run(["ps", "-eo", "pid=,args="], capture_output=True, text=True, check=True).stdout
    return [int(line.split()[0]) for line in found.splitlines() if name in line and "ps -eo" not in line]
