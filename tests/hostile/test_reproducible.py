"""The same inputs give the same bytes: in another process, with another hash seed, in a folder of another name."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.calibration import policies
from tests.lower.modules import captured
from tests.lower.sessions import lower_graph
from ttscompile import compile_denoiser
from ttscompile.calibration.pipeline import calibrate

ROOT = Path(__file__).resolve().parents[2]


def build(folder: Path) -> dict[str, dict[str, str]]:
    """Hashes of what is converted and then calibrated in a new folder."""
    folder.mkdir()
    target, single = folder / "compiled", folder / "single.onnx"
    compile_denoiser(policies.Mixer(0).eval(), policies.spec(), target, single_file=single)
    converted = hashes(target) | hashes(folder)
    recording = policies.record(folder / "calls.npz")
    calibrate(target, [recording], target_sparsity=0.7, max_intervals=2, max_minutes=60, progress=False)
    attention = lower_graph(captured("SelfAttention")[1], "attention").SerializeToString()  # which the mixer has not
    digest = {"attention": hashlib.sha256(attention).hexdigest()}
    return {"convert": converted, "calibrate": hashes(target), "lower": digest}


def hashes(folder: Path) -> dict[str, str]:
    """Of its files, by name."""
    files = (path for path in sorted(folder.iterdir()) if path.is_file())
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.slow
def test_two_processes_make_the_same_bytes(tmp_path: Path) -> None:
    made = []
    for name, seed, zone in (("one", "1", "UTC"), ("other", "4321", "Asia/Tokyo")):
        command = [sys.executable, "-m", "tests.hostile.test_reproducible", str(tmp_path / name)]
        environment = {**os.environ, "PYTHONHASHSEED": seed, "TZ": zone}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        made.append(json.loads(done.stdout.splitlines()[-1]))
    one, other = made
    assert one.keys() == other.keys()
    assert [(part, name) for part in one for name in one[part] if one[part][name] != other[part].get(name)] == []
    assert one == other
    assert one["convert"]["manifest.json"] != one["calibrate"]["manifest.json"]
    assert "single.onnx" in one["convert"]
    assert len(one["convert"]) > 9


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(build(Path(sys.argv[1]))))
