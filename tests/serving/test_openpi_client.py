"""The published client of openpi, which has numpy below 2 and so an environment of its own, against our server."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.serving.serving import listening
from ttscompile.artifact.load import load_artifact
from ttscompile.serving.openpi import OpenPiServer

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / "build" / "openpi-venv" / "bin" / "python"
TOKEN = "a-token-of-these-tests-alone"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not PYTHON.exists(), reason=f"NO CLIENT OF OPENPI: there is no {PYTHON}; run 'make test-openpi'"
    ),
]


def drive(*words: str) -> Any:
    """What the client saw."""
    drives = Path(__file__).with_name("openpi_drive.py")
    done = subprocess.run([PYTHON, drives, *words], capture_output=True, timeout=60)
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stdout)


def test_the_published_client_gets_the_actions_of_the_policy(planned: Path) -> None:
    artifact, policy = load_artifact(planned), ttscompile.load(planned, seed=5)
    with listening(lambda: OpenPiServer(artifact, ttscompile.load(planned, seed=5))) as url:
        seen = drive(url)
    assert seen["metadata"]["observation"] == {"obs": {"shape": [2], "dtype": "float32"}}
    assert seen["metadata"]["identity"] == policy.info.identity
    assert seen["dtypes"] == ["float32"]
    for actions in seen["actions"]:
        policy.reset()
        expected = policy.predict_action({"obs": np.array([[1.0, 2.0]], np.float32)})["action"][0]
        np.testing.assert_array_equal(np.array(actions, np.float32), expected)
    assert "Error in inference server:\nObservationError: " in seen["error"]
    assert "unexpected: ['step']" in seen["error"]


def test_the_published_client_drives_the_command(planned: Path) -> None:
    command = [sys.executable, "-m", "ttscompile", "serve", str(planned), "--openpi", "--port", "0", "--plan", "dense"]
    environment = {**os.environ, "TTSCOMPILE_TOKEN": TOKEN}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as server:
        try:
            assert server.stdout is not None
            first = server.stdout.readline()
            assert first, server.communicate()[1]
            seen = drive(json.loads(first)["url"], TOKEN)
            with pytest.raises(AssertionError, match="401"):
                drive(json.loads(first)["url"])
        finally:
            server.send_signal(signal.SIGINT)
            out, err = server.communicate(timeout=60)
    assert (server.returncode, out) == (0, "")
    assert [json.loads(line)["event"] for line in err.splitlines()] == ["let in", "left", "refused"]
    assert seen["metadata"]["plan"] == "dense"
    assert len(seen["actions"]) == 3 and all(ms > 0 for ms in seen["infer_ms"])
