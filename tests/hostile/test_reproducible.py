"""The same inputs give the same bytes: in other processes, with other hash seeds, in folders of other names."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

CODE = """
import hashlib, json, pathlib, sys
import torch
from tests.calibration import policies
from ttscompile import compile_denoiser
from ttscompile.calibration import calibrate

torch.set_num_threads(1)
folder = pathlib.Path(sys.argv[1])
folder.mkdir()
target = folder / "compiled"

def hashes():
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(target.iterdir())}

compile_denoiser(policies.Mixer(0).eval(), policies.spec(), target, single_file=folder / "single.onnx")
found = {"convert": hashes(), "single": hashlib.sha256((folder / "single.onnx").read_bytes()).hexdigest()}
recording = policies.record(folder / "calls.npz")
calibrate(target, [recording], target_sparsity=0.7, max_intervals=2, max_minutes=60, progress=False)
print(json.dumps({**found, "calibrate": hashes()}))
"""


def build(folder: Path, seed: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", CODE, str(folder)]
    return subprocess.Popen(
        command, cwd=ROOT, env={**os.environ, "PYTHONHASHSEED": seed}, stdout=subprocess.PIPE, text=True
    )


def test_two_processes_make_the_same_bytes(tmp_path: Path) -> None:
    processes = [build(tmp_path / name, seed) for name, seed in (("one", "1"), ("other", "4321"))]
    one, other = (json.loads(process.communicate(timeout=300)[0].splitlines()[-1]) for process in processes)
    assert [process.returncode for process in processes] == [0, 0]
    assert one == other
    assert one["convert"]["manifest.json"] != one["calibrate"]["manifest.json"]
    assert len(one["convert"]) > 8
