"""The Ray Serve example, where Ray is installed."""

import importlib.util
import json
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tests.runtimes.toys import toy_program, written_artifact

if importlib.util.find_spec("ray") is None:
    pytest.skip("NO RAY TESTS: ray is not installed; pip install 'ttscompile[ray]'", allow_module_level=True)

FOLDER = Path(__file__).parents[2] / "examples" / "ray_serve"
WRONG = textwrap.dedent(
    """
    import asyncio, sys
    import numpy as np
    from ray import serve
    from deployment import CompiledPolicy

    async def ask(handle):
        good = [handle.predict.remote({"obs": np.full(2, i, np.float32)}) for i in range(4)]
        wrong = np.zeros(3, np.float32), np.zeros(2, np.float64), np.array(["a", "b"])
        bad = [handle.predict.remote({"obs": array}) for array in wrong]
        return await asyncio.gather(*good, *bad, return_exceptions=True)

    handle = serve.run(CompiledPolicy.bind(sys.argv[1]))
    *good, shape, dtype, text = asyncio.run(ask(handle))
    serve.shutdown()
    assert all(answer.shape == (2, 2) for answer in good), good
    for bad in (shape, dtype, text):
        assert "observation 'obs' must be float32 [2]" in str(bad), bad
    print("done")
    """
)


@pytest.fixture(scope="module")
def artifact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written_artifact(toy_program(pruner=False), tmp_path_factory.mktemp("toy") / "artifact").path


def run(*arguments: object) -> str:
    """Standard output of a script; Ray writes its own messages to both streams."""
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180, cwd=FOLDER, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_requests_of_a_fleet_are_computed_in_batches(artifact: Path) -> None:
    found = json.loads(run("deployment.py", artifact, "--robots", 8, "--rounds", 5).splitlines()[-1])
    assert found["requests"] == 40
    assert found["calls"] < 40
    assert found["mean_batch"] == pytest.approx(40 / found["calls"])


@pytest.mark.slow
def test_an_observation_that_does_not_fit_fails_alone(artifact: Path) -> None:
    assert "done" in run("-c", WRONG, artifact)
