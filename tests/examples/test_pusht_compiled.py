"""The examples on the real policy: scripts as they stand, and the compiled policy against the eager one."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from benchmark import contestants_for, fixed_shares, measure, random_plan
from environments.pusht import PushT
from original import EagerPolicy
from variants import open_variant, seeded_noise

from tests.rounding import PROMISED

pytestmark = pytest.mark.slow

SCRIPTS = Path(__file__).parents[2] / "examples" / "evaluation"


def run(script: str, *arguments: object) -> str:
    """Standard output of an example; its standard error is shown if it fails."""
    command = [sys.executable, str(SCRIPTS / script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def windows() -> np.ndarray:
    environment, frames = PushT(), []
    for seed in range(2):
        environment.reset(seed)
        frames.append(environment.observe()["obs"])
    return np.stack([frames, frames], axis=1)


def test_dense_compiled_is_the_eager_policy(compiled_pusht: Path, pusht_checkpoint: Path, windows: np.ndarray) -> None:
    eager = EagerPolicy(pusht_checkpoint, threads=1)
    dense = open_variant(f"{compiled_pusht}:dense", "onnxruntime", 1)
    assert dense.noise == eager.noise
    noise = seeded_noise(eager.noise, [0, 1], call=0)
    expected = eager.predict_action({"obs": windows}, noise=noise)
    found = dense.policy.predict_action({"obs": windows}, noise=noise, plan="dense")
    assert found["action"].shape == (2, 8, 2)
    for key in ("action", "action_pred"):
        np.testing.assert_allclose(found[key], expected[key], rtol=0, atol=PROMISED * 512)


def test_eager_policy_has_no_plans(pusht_checkpoint: Path, windows: np.ndarray) -> None:
    eager = EagerPolicy(pusht_checkpoint, threads=1)
    noise = seeded_noise(eager.noise, [0, 1], call=0)
    with pytest.raises(ValueError, match="computes everything"):
        eager.predict_action({"obs": windows}, noise=noise, plan=np.zeros((100, 24), np.int8))


def test_contestants_of_the_benchmark(
    compiled_pusht: Path, pusht_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmark.WARM_UP", 1)  # the dense call, so that every cache is written
    given = random_plan(100, 24, 0.05, seed=0)
    contestants, info = contestants_for(compiled_pusht, pusht_checkpoint, 1, given)
    assert [c.label for c in contestants] == ["eager PyTorch", "dense onnxruntime", "given plan, 95% reused"]
    eager, dense, sparse = measure(contestants, runs=1)
    assert eager.flops == info.dense_flops
    assert dense.sparsity == 0.0
    assert sparse.sparsity == pytest.approx(0.95)
    assert sparse.flops < 0.15 * dense.flops
    np.testing.assert_array_equal(sparse.plan, given)
    # The bound on what does not shrink with the plan.
    assert sum(fixed_shares(compiled_pusht).values()) <= 0.03


def test_scripts_run_as_they_stand(compiled_layer: Path, tmp_path: Path) -> None:
    calls = tmp_path / "calls.npz"
    told = run("record.py", compiled_layer, "-o", calls, "--episodes", 1)
    assert "1 episodes" in told
    with np.load(calls, allow_pickle=False) as file:
        rows = len(file["obs"])
        assert file["episode_ends"].tolist() == [rows]
        assert file["obs"].shape == (rows, 2, 20)
    # Nothing but the document on standard output, and the seed's episode is the recorded one.
    output = run("evaluate.py", f"{compiled_layer}:dense", "--episodes", 1, "--first-seed", 0, "--json")
    document = json.loads(output)
    (evaluation,) = document["variants"]
    assert document["machine"]["cores"] >= 1
    assert evaluation["sparsity"] == 0.0
    assert evaluation["episodes"][0]["calls"] == rows
    assert 0 <= evaluation["score"]["mean"] <= 1
    assert f"mean score {evaluation['score']['mean']:.3f}" in told
