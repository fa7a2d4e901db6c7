"""When tokens are reused is settled by what it does to the actions."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from click.testing import CliRunner

import ttscompile
from tests.families import cameras
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import locked
from ttscompile.calibration import tokens
from ttscompile.calibration.tokens import with_spread
from ttscompile.cli import main
from ttscompile.errors import ArtifactError, CalibrationError, CalibrationFailedError, TtscompileError
from ttscompile.verification import verify

SIDE = cameras.SIDE


@pytest.fixture
def folder(once: Once, tmp_path: Path) -> Path:
    """An artifact of its own for each test."""
    return shutil.copytree(cameras.compiled_tokens(once) / "artifact", tmp_path / "own")


def recorded(path: Path, shaking: float = 0.0) -> list[Path]:
    """Four episodes of six calls: a spot wanders over a fixed picture."""
    rng, calls = np.random.default_rng(0), 24
    still = 0.1 + 0.5 * rng.random((2, 3, SIDE, SIDE), dtype=np.float32)
    frames = np.tile(still, (calls + 1, 1, 1, 1, 1))  # [N, camera, ...]
    for i, frame in enumerate(frames):
        frame[:, :, 4 * (i % 6) : 4 * (i % 6) + 4, 8:12] += 0.3
    frames += (shaking * rng.standard_normal(frames.shape)).astype(np.float32)
    windows = np.stack([frames[:-1], frames[1:]], 1)
    views: dict[str, npt.NDArray[np.float32]] = {key: windows[:, :, i] for i, key in enumerate(cameras.CAMERAS)}
    state = rng.random((calls, 2, 4), dtype=np.float32)
    np.savez(path, state=state, episode_ends=np.array([6, 12, 18, 24]), **views)  # type: ignore[arg-type]
    return [path]


@pytest.mark.slow
def test_what_is_settled_saves_and_is_written(folder: Path, tmp_path: Path) -> None:
    found = ttscompile.reuse_tokens(folder, recorded(tmp_path / "calls.npz"))
    reuse = load_artifact(folder).manifest.reuse
    assert reuse == found.reuse
    assert 5 / 37 <= reuse.computed < 0.5
    assert 0 < reuse.error < 0.2 * reuse.other_noise
    assert (reuse.calls, reuse.refresh) == (12, 64)
    (rung,) = (rung for rung in verify(folder).rungs if rung.name == "tokens")
    assert rung.status == "passed"
    computed, of = rung.details["spot"]
    assert 0 < computed < of == 2 * 2 * 37, "of two streams, and two cameras"
    again = ttscompile.reuse_tokens(folder, recorded(tmp_path / "calls.npz"))
    assert again.reuse == found.reuse, "what is settled already changes nothing"


@pytest.mark.slow
def test_what_does_not_pay_is_refused_and_changes_nothing(folder: Path, tmp_path: Path) -> None:
    before = (folder / "manifest.json").read_bytes()
    with pytest.raises(CalibrationFailedError, match=r"does not pay: \d+% of the tokens would be computed"):
        ttscompile.reuse_tokens(folder, recorded(tmp_path / "calls.npz", shaking=0.01), max_action_error=1e-6)
    with pytest.raises(CalibrationFailedError, match="does not pay: the actions differ by"):
        ttscompile.reuse_tokens(folder, recorded(tmp_path / "calls.npz"), max_action_error=1e-9)
    assert (folder / "manifest.json").read_bytes() == before


def test_a_setting_that_is_good_in_one_episode_alone_is_not_taken_for_good() -> None:
    episodes = np.array([0, 0, 0, 1, 1, 1])
    steady, lucky = np.array([2.0, 2.2, 1.8, 2.0, 2.1, 1.9]), np.array([0.4, 0.5, 0.6, 3.0, 3.1, 2.9])
    (mean, bound), (luckier, wider) = with_spread(steady, episodes), with_spread(lucky, episodes)
    assert mean == pytest.approx(2.0)
    assert luckier < mean
    assert wider > bound, "two episodes that differ by 2.5 tell little of a third"
    assert with_spread(steady[:3], episodes[:3]) == (pytest.approx(2.0), pytest.approx(2.0)), "one has no spread"


@pytest.mark.slow
def test_settings_are_chosen_with_their_spread(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = recorded(tmp_path / "calls.npz")
    error = ttscompile.reuse_tokens(folder, files).reuse.error
    monkeypatch.setattr(tokens, "with_spread", lambda errors, _: (float(errors.mean()), 1e3 * error))
    with pytest.raises(CalibrationFailedError, match="two standard errors counted"):
        ttscompile.reuse_tokens(folder, files, max_action_error=2 * error)


def test_nobody_changes_the_artifact_meanwhile(folder: Path, tmp_path: Path) -> None:
    class Told(Exception):
        pass

    def told(*_: object) -> None:
        with pytest.raises(ArtifactError, match="another process is changing the artifact"), locked(folder):
            pass
        raise Told

    with pytest.raises(Told):
        ttscompile.reuse_tokens(folder, recorded(tmp_path / "calls.npz"), calls=2, progress=told)


@pytest.mark.slow
def test_an_encoder_without_tokens_is_refused(once: Once, tmp_path: Path) -> None:
    folder = once.folder("seeing", cameras.compile_seeing) / "artifact"
    with pytest.raises(CalibrationError, match="no image encoder of this policy is a vision transformer"):
        ttscompile.reuse_tokens(folder, recorded(tmp_path / "calls.npz"))


def test_a_zipped_artifact_is_refused_before_anything_is_tried(folder: Path, tmp_path: Path) -> None:
    zipped, told = shutil.make_archive(str(tmp_path / "own"), "zip", folder), list[str]()
    with pytest.raises(TtscompileError, match="Unzip the artifact"):
        ttscompile.reuse_tokens(zipped, recorded(tmp_path / "calls.npz"), progress=lambda what, *_: told.append(what))
    assert not told


@pytest.mark.slow
def test_the_command(folder: Path, tmp_path: Path) -> None:
    files, run = [str(path) for path in recorded(tmp_path / "calls.npz")], CliRunner().invoke
    told = run(main, ["reuse-tokens", str(folder), "--trajectories", *files, "--json"])
    assert told.exit_code == 0, told.output
    document = json.loads(told.stdout)
    assert document["reuse"]["calls"] == 12
    assert "of new frames" in run(main, ["inspect", str(folder)]).stdout
    assert json.loads(run(main, ["inspect", str(folder), "--json"]).stdout)["reuse"] == document["reuse"]
    assert run(main, ["reuse-tokens", str(folder), "--off"]).exit_code == 0
    assert load_artifact(folder).manifest.reuse is None
    assert run(main, ["reuse-tokens", str(folder)]).exit_code == 2
    assert run(main, ["reuse-tokens", str(folder), "--off", "--trajectories", *files]).exit_code == 2
