"""The benchmark of GPUs from end to end, on the CPU and on a small network."""

import json
from pathlib import Path

import gpu
import pytest
from click.testing import CliRunner
from networks import random_network

from ttscompile.errors import RuntimeUnavailableError

EXACT = ["eager PyTorch", "dense, fp32", "75% reused, fp32"]
EXACT += [f"75% reused, fp32, {how}" for how in ("idle steps not fused", "one core")]
PARTS = ("+blocks", "")
NARROW = ["eager PyTorch, bf16", *(f"{plan}, bf16{own}" for plan in ("dense", "75% reused") for own in PARTS)]


def refused(*_: object) -> None:
    raise RuntimeUnavailableError("no compiler")


@pytest.mark.slow
def test_all_contestants_are_timed_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What torch.compile cannot compile is left out, and said; an artifact that is there is taken."""
    made = lambda _: random_network(64, "ddim", 8, layers=1)  # noqa: E731
    monkeypatch.setattr(gpu, "NETWORKS", {"pusht": (made, 0.75)})
    monkeypatch.setattr(gpu, "torch_compile_contestant", refused)
    asked = ["pusht", "--device", "cpu", "--calls", "1", "--output", str(tmp_path)]
    result = CliRunner().invoke(gpu.main, [*asked, "--json"])
    assert result.exit_code == 0, result.stderr
    assert "left out: no compiler" in result.stderr
    rows = json.loads(result.stdout)["rows"]
    off = {row["contestant"]: row["off"] for row in rows}
    assert sorted(off) == sorted((*EXACT, *NARROW))
    assert max(off[label] for label in EXACT) < 1e-5 < min(off[label] for label in NARROW)
    assert max(off.values()) < 0.1
    again = CliRunner().invoke(gpu.main, asked)
    assert again.exit_code == 0 and "compiling" not in again.stderr
    assert all(label in again.stdout for label in EXACT)
