"""The benchmark of GPUs from end to end, on the CPU and on a small network."""

import json
from pathlib import Path

import gpu
import pytest
from click.testing import CliRunner
from networks import random_network

LABELS = [
    "eager PyTorch",
    "dense, fp32",
    "dense, bf16",
    "75% reused, fp32",
    "75% reused, bf16",
    "75% reused, fp32, one core",
]


def refused(network: object) -> None:
    raise RuntimeError("no compiler")


@pytest.mark.slow
def test_all_contestants_are_timed_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What torch.compile cannot compile is left out, and said; an artifact that is there is taken."""
    made = lambda _: random_network(64, "ddim", 8, layers=1)  # noqa: E731
    monkeypatch.setattr(gpu, "NETWORKS", {"pusht": (made, 0.75)})
    monkeypatch.setattr(gpu, "_torch_compile", refused)
    asked = ["pusht", "--device", "cpu", "--calls", "1", "--output", str(tmp_path)]
    result = CliRunner().invoke(gpu.main, [*asked, "--json"])
    assert result.exit_code == 0, result.stderr
    assert "left out: RuntimeError: no compiler" in result.stderr
    rows = json.loads(result.stdout)["rows"]
    assert [row["contestant"] for row in rows] == LABELS
    off = [row["off"] for row in rows]
    assert max(off[0], off[1], off[3], off[5]) < 1e-5 < min(off[2], off[4]) < max(off) < 0.1
    again = CliRunner().invoke(gpu.main, asked)
    assert again.exit_code == 0 and "compiling" not in again.stderr
    assert all(label in again.stdout for label in LABELS)
