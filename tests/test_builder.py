"""From a checkpoint to a chosen plan, in one call and in one command."""

from __future__ import annotations

import shutil
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner
from rich.console import Console

import ttscompile
from tests.artifact.folders import contents
from tests.calibration import policies
from tests.once import Once
from tests.plans import store_schedules
from ttscompile import builder
from ttscompile.artifact.files import aside
from ttscompile.artifact.load import load_artifact, read_manifest
from ttscompile.calibration.state import FILE as STATE
from ttscompile.cli import main, summary
from ttscompile.core.lattice import uniform_plan
from ttscompile.errors import ArtifactError, CalibrationError, CalibrationFailedError, TtscompileError
from ttscompile.runtimes.executor import settings


def building(target: Path) -> Path:
    """Where a build of it works."""
    return aside(target, "building")


@pytest.fixture
def directory(once: Once, tmp_path: Path) -> Path:
    """An artifact of ten steps, of which actions 1 to 4 of 8 are executed."""
    return shutil.copytree(policies.compiled(once), tmp_path / "compiled")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, once: Once) -> dict[str, Any]:
    """What ``convert`` and ``calibrate`` are called with: the one writes an artifact, and the other does nothing."""
    found: dict[str, Any] = {}

    def convert(checkpoint: object, directory: Path, read: Any, **how: Any) -> None:
        found["convert"] = {"checkpoint": checkpoint, "directory": directory, **how}
        read(policies.spec())
        shutil.copytree(policies.compiled(once), directory, dirs_exist_ok=True)

    def calibrate(directory: object, trajectories: object, **how: Any) -> None:
        found["calibrate"] = {"directory": directory, "trajectories": trajectories, **how}

    monkeypatch.setattr(builder, "convert", convert)
    monkeypatch.setattr(builder, "calibrate", calibrate)
    return found


def test_what_applies_is_learned_and_a_control_loop_is_a_deadline(asked: dict[str, Any], directory: Path) -> None:
    recording = policies.record(directory.parent / "calls.npz")
    ttscompile.build("policy.ckpt", directory, [recording], control_hz=50, task="push", progress=False)
    assert asked["convert"]["task"] == "push" and asked["convert"]["precision"] == "int8"
    assert asked["convert"]["prediction_horizon"] == "needed"
    assert ("dpmsolver++", 16) in asked["convert"]["loops"]
    # The toy has neither another precision nor an image encoder.
    assert asked["calibrate"]["learn"] == ["loops"]
    info = ttscompile.load(directory).info
    executed = info.action.stop - info.action.start
    predicted = info.sample[0] - info.action.start
    # A chunk lasts for two calls, the wait for a frame and a tick; and a call takes no longer than what is executed.
    expected = 1e3 * min(executed / 50, (predicted - 2) / 50 / 2)
    assert asked["calibrate"]["latency_ms"] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"control_hz": 50, "latency_ms": 3}, "found latency_ms and control_hz"),
        ({"policy_hz": 0}, "policy_hz: expected a positive number; found 0"),
    ],
)
def test_what_is_no_deadline_or_no_rate_is_refused_before_anything_is_done(
    given: dict[str, Any], told: str, asked: dict[str, Any], directory: Path
) -> None:
    with pytest.raises(CalibrationError, match=told):
        ttscompile.build("policy.ckpt", directory, ["calls.npz"], **given)
    assert not asked


def test_a_loop_that_no_call_keeps_up_with_says_what_to_give(
    asked: dict[str, Any], directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = SimpleNamespace(feasibility=lambda latency: SimpleNamespace(max_latency=0.0))
    monkeypatch.setattr(builder, "resolve", lambda settings, info, control_hz: none)
    recording, before = policies.record(directory.parent / "calls.npz"), contents(directory)
    with pytest.raises(CalibrationFailedError, match="control loop of 50 Hz: .* --policy-hz.$"):
        ttscompile.build("policy.ckpt", directory, [recording], control_hz=50)
    assert "calibrate" not in asked and contents(directory) == before


def test_what_calibration_warns_of_is_not_said_before_it_too(
    asked: dict[str, Any], directory: Path, recwarn: pytest.WarningsRecorder
) -> None:
    recording = policies.record(directory.parent / "calls.npz")
    with np.load(recording) as held:
        np.savez(recording, **held, reward=np.zeros(3))
    ttscompile.build("policy.ckpt", directory, [recording], progress=False)
    assert "calibrate" in asked and not recwarn.list


@pytest.fixture
def calibrated(directory: Path) -> Path:
    """The artifact with a plan."""
    store_schedules(directory, None, {"schedule": uniform_plan(10, 6, 2)}, "schedule", {"seed": 1})
    return directory


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("episodes", [0, 1])
def test_recordings_that_do_not_fit_end_a_build_before_it_compiles(
    episodes: int, given: bool, asked: dict[str, Any], calibrated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are of another size, or of one episode."""
    recording, before = policies.record(calibrated.parent / "calls.npz", episodes or 6), contents(calibrated)
    if not episodes:
        np.savez(recording, obs=np.zeros((4, 2, 9), np.float32), episode_ends=[2, 4])
    monkeypatch.setattr(builder, "recordings_of", lambda *_: str(recording))  # of the policy's training
    with pytest.raises(TtscompileError, match="expected at least two" if episodes else "has shape"):
        ttscompile.build("policy.ckpt", calibrated, [recording] if given else [])
    assert not asked["convert"]["directory"].exists() and "calibrate" not in asked
    assert contents(calibrated) == before
    assert sorted(path.name for path in calibrated.parent.iterdir()) == ["calls.npz", "compiled"]


def test_what_was_built_is_not_lost_where_it_cannot_be_put(
    asked: dict[str, Any], calibrated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody leaves notes in the artifact meanwhile."""
    recording = policies.record(calibrated.parent / "calls.npz")

    def calibrate(made: Path, *_: Any, **__: Any) -> None:
        store_schedules(made, None, {"fast": uniform_plan(10, 6, 2)}, "fast", {"seed": 2})
        (calibrated / "notes.txt").write_text("mine")

    monkeypatch.setattr(builder, "calibrate", calibrate)
    with pytest.raises(ArtifactError, match=r"notes\.txt.* What was done is in"):
        ttscompile.build("policy.ckpt", calibrated, [recording])
    assert (calibrated / "notes.txt").read_text() == "mine"
    assert "schedule" in read_manifest(calibrated).plans
    assert load_artifact(building(calibrated) / "artifact").manifest.default_plan == "fast"


@pytest.mark.parametrize(
    ("error", "exists", "saved"),
    [
        (KeyboardInterrupt, True, True),
        (KeyboardInterrupt, False, False),
        (CalibrationFailedError, True, False),
        (CalibrationFailedError, False, True),
    ],
)
def test_a_build_that_does_not_succeed_changes_nothing_and_can_be_resumed(
    error: type[BaseException],
    exists: bool,
    saved: bool,
    asked: dict[str, Any],
    calibrated: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    target = calibrated if exists else calibrated.parent / "new"
    recording, before = policies.record(calibrated.parent / "calls.npz"), contents(calibrated)
    found: list[bool] = []

    def calibrate(made: Path, *_: Any, **__: Any) -> None:
        found.append((made / STATE).exists())
        if len(found) == 1:
            if saved:
                (made / STATE).touch()
            raise error("nothing is near enough.")
        (made / STATE).unlink(missing_ok=True)
        store_schedules(made, None, {"fast": uniform_plan(10, 6, 2)}, "fast", {"seed": 2})

    monkeypatch.setattr(builder, "calibrate", calibrate)
    with pytest.raises(error) as caught:
        ttscompile.build("policy.ckpt", target, [recording])
    assert contents(calibrated) == before and (exists or not target.exists())
    assert building(target).exists() == saved
    if error is CalibrationFailedError:
        assert (str(building(target)) in str(caught.value)) == saved
    ttscompile.build("policy.ckpt", target, [recording], resume=True)
    assert found == [False, saved]
    assert set(load_artifact(target).plans) == {"dense", "fast"}
    assert not building(target).exists()


@pytest.mark.parametrize("resume", [True, False])
def test_a_build_that_ends_with_the_original_can_be_gone_on_with(
    resume: bool, asked: dict[str, Any], calibrated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its artifact has nothing of the search, and without ``resume`` the next build begins anew."""
    recording, found, told = policies.record(calibrated.parent / "calls.npz"), list[str](), dict[str, tuple[str, ...]]()

    def calibrate(made: Path, *_: Any, **__: Any) -> None:
        found.append((made / STATE).read_text() if (made / STATE).exists() else "none")
        if len(found) == 1:
            (made / STATE).write_text("answers")
        else:
            (made / STATE).unlink(missing_ok=True)

    monkeypatch.setattr(builder, "calibrate", calibrate)
    ttscompile.build("policy.ckpt", calibrated, [recording], explain=told.__setitem__)
    assert load_artifact(calibrated).manifest.default_plan == "dense" and not (calibrated / STATE).exists()
    assert told["end"][0].startswith("the original is the default. The same command with --resume and more --minutes")
    ttscompile.build("policy.ckpt", calibrated, [recording], resume=resume)
    assert found == ["none", "answers" if resume else "none"]
    assert not building(calibrated).exists() and not (calibrated / STATE).exists()


def test_a_build_with_nothing_to_go_on_from_says_so(asked: dict[str, Any], directory: Path) -> None:
    recording, told = policies.record(directory.parent / "calls.npz"), dict[str, tuple[str, ...]]()
    ttscompile.build("policy.ckpt", directory, [recording], resume=True, explain=told.__setitem__)
    assert told["resume"][0].endswith("there is nothing to go on from, so the build begins anew")


@pytest.mark.parametrize("left", ["artifact", "again"])
def test_what_a_killed_build_left_of_a_folder_that_it_removed_is_in_nobodys_way(
    left: str, asked: dict[str, Any], directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without its manifest it is no artifact, and convert would not replace it."""
    folder = building(directory) / left
    folder.mkdir(parents=True)
    (folder / "block_00.onnx").touch()
    if left == "again":  # where the artifact that is gone on with is converted for comparison
        shutil.copytree(directory, building(directory) / "artifact")
        (building(directory) / "artifact" / STATE).touch()

    def convert(_: object, made: Path, **how: Any) -> None:
        assert made == folder and not made.exists()
        shutil.copytree(directory, made)

    monkeypatch.setattr(builder, "convert", convert)
    recording = policies.record(directory.parent / "calls.npz")
    ttscompile.build("policy.ckpt", directory, [recording], progress=False, resume=True)
    assert "calibrate" in asked


def test_two_builds_in_one_place_are_one_too_many(
    asked: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = policies.record(tmp_path / "calls.npz")

    def calibrate(made: Path, *_: Any, **__: Any) -> None:
        with pytest.raises(ArtifactError, match="another process is changing the artifact"):
            ttscompile.build("policy.ckpt", tmp_path / "new", [recording])
        assert made.exists()

    monkeypatch.setattr(builder, "calibrate", calibrate)
    ttscompile.build("policy.ckpt", tmp_path / "new", [recording])
    assert (tmp_path / "new").exists()


def test_every_option_of_the_command_reaches_the_call(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls: list[dict[str, Any]] = []

    def build(checkpoint: object, directory: object, trajectories: object, **how: Any) -> None:
        calls.append({"checkpoint": checkpoint, "directory": directory, "trajectories": trajectories, **how})
        raise CalibrationFailedError("no plan is near enough")

    monkeypatch.setattr("ttscompile.build", build, raising=False)
    checkpoint, recording = tmp_path / "policy.ckpt", tmp_path / "calls.npz"
    checkpoint.touch()
    recording.touch()
    words = ["build", str(checkpoint), "-t", str(recording), "-o", str(tmp_path / "out")]
    more = ["--latency-ms", "8", "--error", "0.1", "--threads", "2", "--minutes", "5", "--resume"]
    result = CliRunner().invoke(main, [*words, *more])
    assert result.exit_code == 1 and "no plan is near enough" in result.stderr
    (found,) = calls
    known = {"latency_ms": 8.0, "max_distance": 0.1, "threads": 2, "max_minutes": 5.0, "resume": True}
    assert known.items() <= found.items()
    options = {one.name for one in main.commands["build"].params if isinstance(one, click.Option)}
    taken = {"trajectories", "directory", "sources", "error", "minutes", "as_json"}
    assert options - taken <= set(found)


@pytest.mark.parametrize("said", ["by who builds", "by the recording", "by nobody"])
def test_the_rate_of_training_is_kept_and_decides_the_deadline(
    said: str, asked: dict[str, Any], directory: Path
) -> None:
    """A control loop of 50 Hz leaves a policy of 10 Hz five times as long as one of 50 Hz."""
    given: dict[str, Any] = {"policy_hz": 10} if said == "by who builds" else {}
    path = policies.record(directory.parent / "calls.npz")
    if said == "by the recording":
        np.savez(path, **np.load(path), meta=np.array('{"policy_hz": 10}'))
    notes = dict[str, tuple[str, ...]]()
    ttscompile.build("policy.ckpt", directory, path, control_hz=50, progress=False, explain=notes.__setitem__, **given)
    info = ttscompile.load(directory).info
    hz = 50 if said == "by nobody" else 10
    *assumed, kept = notes["loop"]
    plays = "the executor plays 4 actions of a chunk, and has 3 more in reserve for one that comes late"
    assert kept == f"calls may take {asked['calibrate']['latency_ms']:.4g} ms: {plays}, at {hz} Hz"
    told = "nobody says at which rate the policy was trained: 50 Hz are assumed (--policy-hz)"
    assert assumed == [told] * (said == "by nobody")
    assert asked["calibrate"]["policy_hz"] == (None if said == "by nobody" else 10)
    longest = settings.resolve(settings.ExecutorSettings(policy_hz=hz), info, 50).feasibility(1e-3).max_latency
    assert asked["calibrate"]["latency_ms"] == pytest.approx(1e3 * longest)


@pytest.mark.slow
def test_a_checkpoint_becomes_a_policy(
    one_layer_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole command, on one layer of the Push-T policy; and what it says is what it wrote."""
    draw = np.random.default_rng(0)
    walks = np.cumsum(draw.normal(0, 4, (24, 1, 20)), 0) + draw.uniform(200, 300, (24, 1, 20))
    recording = tmp_path / "calls.npz"
    np.savez(recording, obs=np.repeat(walks, 2, 1).astype(np.float32), episode_ends=[6, 12, 18, 24])
    words = ["build", str(one_layer_checkpoint), "-t", str(recording), "-o", str(tmp_path / "compiled")]
    result = CliRunner().invoke(main, [*words, "--minutes", "0.05", "--error", "3"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    artifact = load_artifact(tmp_path / "compiled")
    record = artifact.manifest.calibration
    assert record is not None and artifact.manifest.default_plan == "schedule"
    assert set(artifact.manifest.spec.loops) == {"dpmsolver++-16", "ddim-16"}
    assert artifact.manifest.spec.sample[0] == 13, "four of the sixteen actions are needed by nobody"
    (chosen,) = (row for row in record["frontier"] if row["name"] == "schedule")
    told = f"Chosen among {len(record['frontier'])} plans: {chosen['told']}"
    assert told in " ".join(result.output.split())
    lines = result.output.splitlines()
    for row in record["frontier"]:
        assert any(row["name"] in line and row["told"] in line for line in lines), "a plan is a line"
    instructed = "observation['task'] = "
    assert instructed not in result.output
    (dense,) = (row for row in record["frontier"] if row["name"] == "dense")
    dense["distance"] = -1e-9  # rounding
    chosen |= {"near": False, "confirmed": {"distance": 0.3, "interval": [0, 1]}}  # too far on other calls
    monkeypatch.setattr(summary, "instruct_of", lambda each: each is artifact)  # of a policy that is told its task
    summary.print_frontier(artifact, tmp_path, Console(file=(printed := StringIO()), width=200), 1)
    assert instructed in printed.getvalue() and "AsyncExecutor" not in printed.getvalue()
    assert "-0.000" not in printed.getvalue() and printed.getvalue().count("0.300 too far") == 1
    summary.print_frontier(artifact, tmp_path, Console(file=(printed := StringIO())), 1, control_hz=50.0)
    loop = printed.getvalue().partition("    with ttscompile.")[2].splitlines()
    assert loop[0] == "AsyncExecutor(policy, control_hz=50) as executor:"
    assert loop[3].startswith(f"            {instructed}")
    assert [line.strip() for line in loop[4:8]] == [
        "executor.observe(observation)  # one frame, by key",
        "if executor.ready:",
        "robot.move(executor.action())",
        "wait_for_the_next_tick()",
    ]
    assert not (tmp_path / "compiled" / STATE).exists()


def test_a_build_of_another_checkpoint_is_not_resumed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, directory: Path
) -> None:
    def convert(_: object, path: Path, **how: Any) -> None:
        ttscompile.compile_denoiser(policies.Mixer(1).eval(), policies.spec(), path)

    kept = building(tmp_path / "new") / "artifact"
    shutil.copytree(directory, kept)
    before = read_manifest(directory).model_identity
    (kept / STATE).touch()
    monkeypatch.setattr(builder, "convert", convert)
    with pytest.raises(CalibrationError, match="found another model. Leave --resume out"):
        ttscompile.build("other.ckpt", tmp_path / "new", ["calls.npz"], resume=True)
    assert read_manifest(kept).model_identity == before
    assert [path.name for path in kept.parent.iterdir()] == ["artifact"], "nothing is left beside it"
