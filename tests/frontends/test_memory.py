"""How much memory a conversion takes, as a multiple of the weights."""

import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from ttscompile.errors import CheckpointError
from ttscompile.frontends import saved_weights
from ttscompile.policies.networks.language_layers import LanguageConfig

from ..policies import pis

ROOT = Path(__file__).resolve().parents[2]

MOST = 1.2
"""Of the weights, 386 MiB: it was 0.7, and 2.3 with a copy for the capture and one for the exporter's examples."""


@pytest.mark.soak
@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="needs /proc/self/smaps_rollup")
@pytest.mark.parametrize("halved", [False, True])
def test_weights_are_not_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, halved: bool) -> None:
    """They are mapped, and the module, the graphs and the golden record read them where they are.

    So are the copies of those that were not saved in float32.
    """
    large = LanguageConfig(width=1024, hidden=16384, layers=2, heads=8, groups=1, channels=8, gemma=True)
    monkeypatch.setattr(pis, "TEXT", large)
    policy = pis.save("pi0", tmp_path / "policy")
    with safe_open(policy / "model.safetensors", "np") as file:
        numbers = sum(math.prod(file.get_slice(name).get_shape()) for name in file.keys())  # noqa: SIM118
    assert 4 * numbers > 380 * 2**20
    if halved:
        path = policy / "model.safetensors"
        weights = {name: value.bfloat16() for name, value in load_file(path).items()}
        path.unlink()  # it is mapped
        save_file(weights, path)
    command = [sys.executable, "examples/benchmark/memory.py", str(policy), str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    taken = int(done.stdout) / (4 * numbers)
    assert taken < MOST, f"{taken:.2f} times the weights are held in memory"


HAS_MAPS = pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="needs /proc/self/maps")


@pytest.fixture
def mapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of large files for a while, which copies of any size are put into."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(saved_weights, "_LEAST_MAPPED", 0)
    return tmp_path


HALVED = {"halved": torch.linspace(-3, 3, 12).reshape(3, 4).bfloat16(), "none": torch.zeros(0, 2).half()}


@HAS_MAPS
def test_copies_are_in_a_file_that_has_no_name(mapped: Path) -> None:
    whole = torch.arange(5.0)
    found = saved_weights.as_float32({**HALVED, "module.whole": whole})
    assert {name: value.dtype for name, value in found.items()} == dict.fromkeys(
        ("halved", "none", "whole"), torch.float32
    )
    assert torch.equal(found["halved"], HALVED["halved"].float()) and found["none"].shape == (0, 2)
    assert found["whole"].data_ptr() == whole.data_ptr(), "what is in float32 is not copied"
    assert list(mapped.iterdir()) == []
    shared = [line for line in Path("/proc/self/maps").read_text().splitlines() if str(mapped) in line]
    assert [line.split()[1][-1] for line in shared] == ["s"]


@HAS_MAPS
def test_where_the_disk_has_no_room_copies_are_in_memory(mapped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    assert torch.equal(saved_weights.as_float32(HALVED)["halved"], HALVED["halved"].float())
    assert str(mapped) not in Path("/proc/self/maps").read_text()


def test_copies_count_where_they_have_no_room_on_disk(mapped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = [(2**28, False), (2**28, True)]
    monkeypatch.setattr(saved_weights, "memory_bytes", lambda: 2**30 + 1)
    saved_weights.require_memory_for(mapped / "policy", sizes)
    told = "about 2.0 GiB of memory.* 1.0 GiB of it can be on disk: .* has no room, so set TMPDIR"
    with monkeypatch.context() as full:
        full.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=2**29))
        with pytest.raises(CheckpointError, match=told):
            saved_weights.require_memory_for(mapped / "policy", sizes)
    monkeypatch.setenv("TMPDIR", str(mapped / "nowhere"))
    with pytest.raises(CheckpointError, match=told):
        saved_weights.require_memory_for(mapped / "policy", sizes)
    saved_weights.require_memory_for(mapped / "policy", [(2**28, True)])
    assert torch.equal(saved_weights.as_float32(HALVED)["halved"], HALVED["halved"].float())
