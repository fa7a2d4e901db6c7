"""``convert --single-file``: the file beside the artifact, and what the command says of it."""

import json
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from click.testing import CliRunner
from torch import nn

import ttscompile
from tests.calibration.policies import spec
from ttscompile import Noise
from ttscompile.cli import main
from ttscompile.driver import compile_denoiser
from ttscompile.errors import ArtifactError


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["fp32", "int8"])
def test_convert_writes_one_file_of_the_same_policy(one_layer_checkpoint: Path, tmp_path: Path, precision: str) -> None:
    file = tmp_path / "policy.onnx"
    command = ["convert", one_layer_checkpoint, "-o", tmp_path / "compiled", "--single-file", file]
    as_json = precision == "fp32"
    command += ["--sampler", "ddim", "--steps", 4, "--precision", precision, *["--json"] * as_json]
    result = CliRunner().invoke(main, [str(word) for word in command], catch_exceptions=False)
    assert result.exit_code == 0, result.stderr
    size = f"{file.stat().st_size / 1e6:.1f} MB"
    told = f"it runs plans of loop 'ddim-4' in {precision}, but none that have weights of their own or begin with the"
    told += " chunk of the call before: ttscompile.load runs these"
    if as_json:
        assert json.loads(result.stdout)["stages"][-1] == {"stage": "write_single_file", "notes": [size, told]}
    else:
        assert result.stdout.endswith(f"single file: {file}, {size}; {told}\n")

    policy = ttscompile.load(tmp_path / "compiled")
    rng = np.random.default_rng(0)
    obs = {"obs": rng.uniform(100, 400, (1, 2, 20)).astype(np.float32)}
    noise = Noise(rng.standard_normal((1, 16, 2), dtype=np.float32))
    plan = np.zeros((4, 3), np.int8)
    plan[2] = ttscompile.Source.TIMESTEP
    expected = policy.predict_action(obs, noise=noise, plan=plan)["action"]
    feeds = {**obs, "initial_noise": noise.initial, "plan": plan[None], "rollout_keep": np.zeros((4, 3), np.bool_)}
    feeds |= {"rollout_rows": np.zeros((0, 1, 16, 64), np.float32), "rollout_index": np.full((1, 4, 3), -1)}
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    (found,) = session.run(["action"], feeds)
    # Actions are pixels, 0 to 512; int8 rounds values that differ in the last bit to different integers.
    assert np.abs(found - expected).max() < (0.05 if precision == "fp32" else 5.0)


@pytest.mark.parametrize("inside", ["compiled", "compiled/call.onnx", "compiled/more/call.onnx", "link/call.onnx"])
def test_a_file_inside_of_the_artifact_is_refused_before_any_work(tmp_path: Path, inside: str) -> None:
    """The next convert or calibrate would replace it with the artifact."""
    (tmp_path / "link").symlink_to(tmp_path / "compiled")
    with pytest.raises(ArtifactError, match="outside of the artifact") as raised:
        compile_denoiser(nn.Identity(), spec(), tmp_path / "compiled", single_file=tmp_path / inside)
    assert "another path" in str(raised.value)
    with pytest.raises(ArtifactError, match="found a directory"):
        compile_denoiser(nn.Identity(), spec(), tmp_path / "compiled", single_file=tmp_path)
    assert not (tmp_path / "compiled").exists()
