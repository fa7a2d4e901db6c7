"""From which step a call goes on with the chunk of the call before: settled on recorded episodes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.settle import settle
from ttscompile.artifact.warm import WarmRecord
from ttscompile.artifact.write import locked
from ttscompile.calibration import warm_start
from ttscompile.cli import main
from ttscompile.errors import ArtifactError, CalibrationError, CalibrationFailedError, SpecError

STEPS, ENOUGH = 8, 1e6


@pytest.fixture
def folder(one_layer_checkpoint: Path, once: Once, tmp_path: Path) -> Path:
    def convert(path: Path) -> None:
        ttscompile.convert(one_layer_checkpoint, path, sampler="ddim", steps=STEPS)

    compiled, _ = once.compiled("warm start", convert)
    return Path(shutil.copytree(compiled, tmp_path / "artifact"))


def recorded(path: Path, episodes: int = 3, calls: int = 4) -> list[Path]:
    rng = np.random.default_rng(0)
    ends = calls * np.arange(1, episodes + 1)
    np.savez(path, obs=rng.uniform(100, 400, (ends[-1], 2, 20)).astype(np.float32), episode_ends=ends)
    return [path]


@pytest.mark.slow
def test_what_is_settled_is_what_a_policy_is_loaded_with(folder: Path, tmp_path: Path) -> None:
    identity = load_artifact(folder).manifest.identity
    found = ttscompile.warm_start(folder, recorded(tmp_path / "calls.npz"), max_distance=ENOUGH)
    manifest = load_artifact(folder).manifest
    assert (manifest.warm, manifest.identity) == (found.warm, identity)
    assert (found.warm.last_steps, found.warm.calls, found.warm.allowed) == (1, 9, ENOUGH)
    assert len(found.tried) == 1
    assert ttscompile.load(folder, warm=True).info.warm_steps == 1
    assert ttscompile.load(folder).info.warm_steps is None


@pytest.mark.slow
def test_the_fewest_steps_within_the_distance_are_taken(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distances = {1: (1.0, 1.5), 2: (1.4, 1.0), 3: (1.2, 1.2)}

    def tried(self: object, rest: object, start: object) -> warm_start.Tried:
        steps = rest.manifest.steps  # type: ignore[attr-defined]
        return warm_start.Tried(steps, *distances[steps])

    monkeypatch.setattr(warm_start._Measured, "tried", tried)
    files = recorded(tmp_path / "calls.npz")
    assert ttscompile.warm_start(folder, files, max_distance=1.2).warm.last_steps == 3
    assert ttscompile.warm_start(folder, files, max_distance=1.4).warm.last_steps == 2
    before = (folder / "manifest.json").read_bytes()
    with pytest.raises(CalibrationFailedError, match=r"the last 3 give distances of 1.2 .* 1.2, and 1.1 is allowed"):
        ttscompile.warm_start(folder, files, max_distance=1.1)
    assert (folder / "manifest.json").read_bytes() == before


@pytest.mark.slow
def test_a_distance_is_one_where_nothing_of_the_chunk_is_left(folder: Path, tmp_path: Path) -> None:
    """Told by hand: calls that begin with noise alone, and with the whole of the chunk before."""
    artifact = load_artifact(folder)
    episodes = warm_start.load_episodes(artifact.manifest.spec, recorded(tmp_path / "calls.npz", 4, 12), None)
    measured = warm_start._Measured(artifact, episodes, 512, 0)

    class AllNoise(warm_start.Start):
        def noise_from(self, before, chunk, fresh):  # type: ignore[no-untyped-def]
            return fresh

    whole = measured.tried(artifact, AllNoise(0, 0.0, 1.0))
    assert (whole.same, whole.changed) == (pytest.approx(1.0), pytest.approx(1.0)), "these are the dense calls"
    few, many = (measured.tried(*warm_start.with_last_steps(artifact, n)) for n in (1, 4))
    assert few.changed > many.changed, "a later start keeps more of the chunk"


def test_the_world_changes_to_another_episode_that_lasts_as_long(folder: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "calls.npz", obs=np.full((10, 2, 20), 200, np.float32), episode_ends=[3, 7, 8, 10])
    spec = load_artifact(folder).manifest.spec
    episodes = warm_start.load_episodes(spec, [tmp_path / "calls.npz"], None)
    rng = np.random.default_rng(0)
    assert {warm_start.another(episodes, 1, 1, rng) for _ in range(50)} == {0, 3}
    assert {warm_start.another(episodes, 1, 2, rng) for _ in range(50)} == {0}


@pytest.mark.slow
def test_calls_are_spread_over_episodes_and_have_one_before_them(folder: Path, tmp_path: Path) -> None:
    files = recorded(tmp_path / "calls.npz", 3, 5)
    assert ttscompile.warm_start(folder, files, max_distance=ENOUGH).warm.calls == 12
    assert ttscompile.warm_start(folder, files, calls=4, max_distance=ENOUGH).warm.calls == 4
    episodes = warm_start.load_episodes(load_artifact(folder).manifest.spec, files, None)
    assert [episode for episode, _ in warm_start._places(episodes, 3)] == [0, 1, 2]
    assert all(row > 0 for _, row in warm_start._places(episodes, 512))


def test_too_little_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="two episodes of two calls, at least; found 3 episodes, of at most 1 c"):
        ttscompile.warm_start(folder, recorded(tmp_path / "calls.npz", 3, 1))
    with pytest.raises(CalibrationError, match="hold one episode"):
        ttscompile.warm_start(folder, recorded(tmp_path / "calls.npz", 1, 4))
    with pytest.raises(CalibrationError, match="max_distance: expected a positive number; found -1"):
        ttscompile.warm_start(folder, recorded(tmp_path / "calls.npz"), max_distance=-1)


@pytest.mark.slow
def test_a_loop_of_two_steps_has_half(one_layer_checkpoint: Path, tmp_path: Path) -> None:
    ttscompile.convert(one_layer_checkpoint, tmp_path / "one", sampler="ddim", steps=2)
    found = ttscompile.warm_start(tmp_path / "one", recorded(tmp_path / "calls.npz"), max_distance=ENOUGH)
    assert found.warm.last_steps == 1
    with pytest.raises(SpecError, match="expected fewer than the 2 steps"):
        ttscompile.load(tmp_path / "one", warm=2)


def test_nobody_changes_the_artifact_meanwhile(folder: Path, tmp_path: Path) -> None:
    class Told(Exception):
        pass

    def told(*_: object) -> None:
        with pytest.raises(ArtifactError, match="another process is changing the artifact"), locked(folder):
            pass
        raise Told

    with pytest.raises(Told):
        ttscompile.warm_start(folder, recorded(tmp_path / "calls.npz"), progress=told)


def test_a_record_of_more_steps_than_there_are_is_refused(folder: Path) -> None:
    with pytest.raises(ArtifactError, match=r"warm: expected fewer than the 8 steps of the loop"):
        settle(folder, "warm", WarmRecord(STEPS, 1.0, 1.0, 1.1, 9))
    assert load_artifact(folder).manifest.warm is None


@pytest.mark.slow
def test_the_command(folder: Path, tmp_path: Path) -> None:
    files, run = [str(path) for path in recorded(tmp_path / "calls.npz")], CliRunner().invoke
    words = ["warm-start", str(folder), "--trajectories", *files, "--max-distance", "1000000"]
    told = run(main, [*words, "--json"])
    assert told.exit_code == 0, told.output
    document = json.loads(told.stdout)
    assert (document["warm"]["last_steps"], document["warm"]["calls"]) == (1, 9)
    assert document["tried"][0]["changed"] == document["warm"]["changed"]
    assert "compute the last 1 of 8 steps" in " ".join(run(main, words).stdout.split())
    assert "compute the last 1 of 8 steps" in " ".join(run(main, ["inspect", str(folder)]).stdout.split())
    assert json.loads(run(main, ["inspect", str(folder), "--json"]).stdout)["warm"] == document["warm"]
    refused = run(main, [*words[:-1], "0.001"])
    assert refused.exit_code == 1
    assert "not like a dense call" in " ".join(refused.stderr.split())
    assert run(main, ["warm-start", str(folder), "--off"]).exit_code == 0
    assert load_artifact(folder).manifest.warm is None
    assert run(main, ["warm-start", str(folder)]).exit_code == 2
    assert run(main, ["warm-start", str(folder), "--off", "--trajectories", *files]).exit_code == 2
