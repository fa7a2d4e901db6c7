"""One at a time changes an artifact: a second one is told so at once, and a kill leaves nothing locked."""

import fcntl
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import ttscompile
from tests.artifact.folders import contents
from tests.plans import store_schedules
from ttscompile.artifact.files import exchange, lock_folder, locked
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import pipeline
from ttscompile.calibration.calls import load_episodes
from ttscompile.calibration.pipeline import CalibrationResult
from ttscompile.errors import ArtifactError

from . import policies

REFUSED = "another process is changing the artifact: it calibrates it, or converts"


def calibrate(artifact: Path, recording: Path) -> CalibrationResult:
    return ttscompile.calibrate(artifact, [recording], 0.8, max_intervals=4, progress=False)


@pytest.mark.slow
def test_a_calibration_refuses_all_others_from_its_beginning(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began: list[str] = []

    def meanwhile(*arguments: Any) -> Any:
        """Where the first one reads its recordings."""
        assert not began, "the second calibration went on"
        began.append("first")
        before = contents(artifact)
        with pytest.raises(ArtifactError, match=REFUSED):
            calibrate(artifact, recording)
        with pytest.raises(ArtifactError, match=REFUSED):
            store_schedules(artifact, None, {}, "dense", {})
        with pytest.raises(ArtifactError, match=REFUSED):
            ttscompile.convert(artifact / "none.ckpt", artifact)
        with pytest.raises(ArtifactError, match=REFUSED):
            ttscompile.compile_denoiser(policies.Mixer(3).eval(), policies.spec(), artifact)
        assert contents(artifact) == before
        assert load_artifact(artifact).manifest.default_plan == "dense"  # reading waits for nobody
        return load_episodes(*arguments)

    monkeypatch.setattr(pipeline, "load_episodes", meanwhile)
    result = calibrate(artifact, recording)
    assert load_artifact(artifact).manifest.default_plan == result.default_plan
    with locked(artifact):  # it let go
        pass


def test_a_kill_leaves_nothing_locked(artifact: Path) -> None:
    script = (
        "import sys, time; from pathlib import Path; from ttscompile.artifact.files import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script, artifact], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(ArtifactError, match=REFUSED), locked(artifact):
            pass
        holder.kill()
    with locked(artifact):
        pass


def test_a_folder_that_was_replaced_before_it_was_locked(
    artifact: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What would be locked is no longer at this path, and whoever comes there next would have it to himself."""
    (tmp_path / "other").mkdir()
    flock = fcntl.flock

    def late(descriptor: int, operation: int) -> None:
        exchange(artifact, tmp_path / "other")
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    with pytest.raises(BlockingIOError), lock_folder(artifact):
        pass
