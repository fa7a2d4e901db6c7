"""How much memory a conversion takes, as a multiple of the weights."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors import safe_open

from ttscompile.frontends.language_layers import LanguageConfig

from . import pis

ROOT = Path(__file__).resolve().parents[2]

MOST = 1.2
"""Of the weights, 386 MiB: it was 0.7, and 2.3 with a copy for the capture and one for the exporter's examples."""


@pytest.mark.soak
@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="needs /proc/self/smaps_rollup")
def test_weights_are_not_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are mapped, and the module, the graphs and the golden record read them where they are."""
    large = LanguageConfig(width=1024, hidden=16384, layers=2, heads=8, groups=1, channels=8, gemma=True)
    monkeypatch.setattr(pis, "TEXT", large)
    policy = pis.save("pi0", tmp_path / "policy")
    with safe_open(policy / "model.safetensors", "np") as file:
        numbers = sum(math.prod(file.get_slice(name).get_shape()) for name in file.keys())  # noqa: SIM118
    assert 4 * numbers > 380 * 2**20
    command = [sys.executable, "examples/benchmark/memory.py", str(policy), str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    taken = int(done.stdout) / (4 * numbers)
    assert taken < MOST, f"{taken:.2f} times the weights are held in memory"
