"""Calibrations of copies at the same time: each finds what it finds alone."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.artifact.folders import contents
from ttscompile.artifact.load import load_artifact

SCRIPT = """
import sys
import torch
import ttscompile

torch.set_num_threads(1)
ttscompile.calibrate(sys.argv[1], [sys.argv[2]], 0.8, max_intervals=4, seed=0, progress=False)
"""


@pytest.mark.soak
def test_four_calibrations_of_copies_at_once(artifact: Path, recording: Path, tmp_path: Path) -> None:
    """What a plan is does not depend on what else the machine does, and no state or lock is anybody else's."""
    copies = [Path(shutil.copytree(artifact, tmp_path / f"copy-{number}")) for number in range(5)]
    before = sorted(path.name for path in tmp_path.iterdir())

    def begin(copy: Path) -> subprocess.Popen[str]:
        return subprocess.Popen([sys.executable, "-c", SCRIPT, copy, recording], stderr=subprocess.PIPE, text=True)

    alone = begin(copies[4])
    assert (alone.communicate(timeout=300)[1], alone.returncode) == ("", 0)
    running = [begin(copy) for copy in copies[:4]]
    for process in running:
        assert (process.communicate(timeout=600)[1], process.returncode) == ("", 0)
    plans = {load_artifact(copy).manifest.identity for copy in copies}
    assert len(plans) == 1
    found = [{name: content for name, content in contents(copy).items() if name != "manifest.json"} for copy in copies]
    assert all(each == found[0] for each in found)
    assert sorted(path.name for path in tmp_path.iterdir()) == before, "nothing is left beside them"
