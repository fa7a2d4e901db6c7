"""The comparison of plans and artifacts: what it measures, and what it refuses to compare."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import ttscompile
from tests.commands import as_json, done, refused
from tests.families import cameras
from tests.once import Once
from tests.plans import store_schedules
from ttscompile import SamplerTable
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.calibration.compare import _require_same_policy, compare
from ttscompile.calibration.pipeline import calibrate
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import TokenReuse
from ttscompile.errors import CalibrationError, OutputError
from ttscompile.measure.points import Comparison, MeasuredPoint
from ttscompile.plots.figure import write_picture
from ttscompile.plots.frontier import plot_frontier

from . import policies

pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def other_sampler(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same network with a deterministic sampler of five steps."""
    spec = policies.spec(noise=0.0)
    rows: dict[str, Any] = {
        name: np.ascontiguousarray(getattr(spec.sampler, name)[::2]) for name in SamplerTable.COLUMNS
    }
    sampler = replace(spec.sampler, name="five", timesteps=spec.sampler.timesteps[::2].copy(), **rows)
    directory = tmp_path_factory.mktemp("five") / "five"
    ttscompile.compile_denoiser(policies.Mixer(0).eval(), replace(spec, sampler=sampler), directory)
    return directory


@pytest.fixture(scope="session")
def frontier(planned: Path, other_sampler: Path, recording: Path) -> Comparison:
    return compare(planned, [recording], [other_sampler], calls=8)


def points(frontier: Comparison) -> dict[tuple[str, str], MeasuredPoint]:
    return {(point.series, point.name): point for point in frontier.points}


def test_every_plan_is_measured_on_the_same_calls(frontier: Comparison) -> None:
    found = points(frontier)
    assert list(found) == [("this artifact", "dense"), ("this artifact", "half"), ("five", "dense")]
    dense = found["this artifact", "dense"]
    assert (dense.error or 0.0) < 1e-6  # the truth, with the same noise, in another runtime
    assert dense.distance == pytest.approx(0.0, abs=1e-3)
    assert found["this artifact", "half"].sparsity == 0.5
    assert all(point.latency_ms > 0 for point in found.values())
    assert {point.series for point in frontier.points if point.error is None} == {"five"}  # which has other noise
    assert found["five", "dense"].distance > 0.1
    assert all(point.interval[0] <= point.distance <= point.interval[1] for point in frontier.points)
    assert frontier.other_noise > 0.01
    assert frontier.calls == 8


def test_it_says_where_plans_may_have_been_learned_from_these_episodes(planned: Path, frontier: Comparison) -> None:
    assert len(frontier.warnings) == 1
    assert frontier.warnings[0].startswith("this artifact: this comparison judges on the episodes [")
    told = "], and its calibration held out the episodes [0, 1]. If it learned from these recordings,"
    assert told in frontier.warnings[0]


def test_episodes_of_the_same_numbers_are_not_the_same_episodes(
    compiled: Path, recording: Path, tmp_path: Path
) -> None:
    with np.load(recording) as given:
        arrays = dict(given)
    turned = {key: array if key == "episode_ends" else array[::-1] for key, array in arrays.items()}
    np.savez(tmp_path / "turned.npz", **turned)
    directory = Path(shutil.copytree(compiled, tmp_path / "own"))
    calibrate(directory, [recording], 0.5, learn=("interval",), max_intervals=1, progress=False)
    assert compare(directory, [recording], calls=1).warnings == ()
    (warning,) = compare(directory, [tmp_path / "turned.npz"], calls=1).warnings
    assert warning.startswith("this artifact: this comparison judges on the episodes [")
    assert "its calibration held out other ones of these numbers. If it learned from these" in warning


def test_nothing_is_written(planned: Path, recording: Path) -> None:
    before = {path.name: path.read_bytes() for path in planned.iterdir()}
    compare(planned, [recording], calls=1)
    assert {path.name: path.read_bytes() for path in planned.iterdir()} == before


@pytest.fixture
def seen(once: Once, tmp_path: Path) -> tuple[Path, Path, dict[str, Any]]:
    """A policy with cameras, a recording for it, and what its cameras show in there."""

    def make(folder: Path) -> None:
        ttscompile.compile_denoiser(*cameras.policy("clip"), folder / "artifact")

    folder, size = once.folder("tokens in fp32", make) / "artifact", (8, 2, 3, cameras.SIDE, cameras.SIDE)
    views: dict[str, Any] = {key: np.random.default_rng(0).random(size) for key in cameras.CAMERAS}
    np.savez(tmp_path / "calls.npz", state=np.zeros((8, 2, 4), np.float32), episode_ends=np.array([4, 8]), **views)
    return Path(shutil.copytree(folder, tmp_path / "own")), tmp_path / "calls.npz", views


def test_the_truth_has_all_tokens(seen: tuple[Path, Path, dict[str, Any]]) -> None:
    """With a threshold that nothing passes the newest of two frames is taken for the one before."""
    folder, recorded, _ = seen
    dense = load_artifact(folder).plans["dense"]
    update_plans(folder, {"reusing": replace(dense, tokens=TokenReuse(100.0, 64))}, "reusing")
    whole, reusing = compare(folder, [recorded], calls=4).points
    assert (whole.error or 0.0) < 1e-5 < (reusing.error or 0.0)
    assert whole.distance < reusing.distance


def test_what_cannot_be_compared_is_refused(
    planned: Path, linear_policy: Path, recording: Path, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError, match="same checkpoint; found other weights"):
        compare(planned, [recording], [linear_policy])
    with pytest.raises(CalibrationError, match=f"two artifacts are called '{planned.name}'"):
        compare(planned, [recording], [planned, shutil.copytree(planned, tmp_path / planned.name)])
    with pytest.raises(CalibrationError, match="one episode; expected at least two"):
        compare(planned, [policies.record(tmp_path / "one.npz", episodes=1)])


def test_an_artifact_that_predicts_fewer_steps_is_of_the_same_policy(planned: Path) -> None:
    artifact = load_artifact(planned)
    manifest, (steps, channels) = artifact.manifest, artifact.manifest.spec.sample

    def predicting(count: int, weight: float = 0.0, left_out: int = 0) -> Artifact:
        spec = replace(manifest.spec, sample=(count, channels), left_out=left_out)
        weights = {**artifact.weights, "mask": np.zeros(count), "weight": np.full(3, weight)}
        return replace(artifact, manifest=replace(manifest, spec=spec), weights=weights)

    narrow = predicting(steps, left_out=2)
    _require_same_policy(narrow, predicting(steps + 2), "other")
    with pytest.raises(CalibrationError, match="found other weights"):
        _require_same_policy(narrow, predicting(steps + 2, weight=1.0), "other")
    with pytest.raises(CalibrationError, match="found other weights"):
        _require_same_policy(narrow, replace(predicting(steps + 2), weights={"mask": np.zeros(steps + 2)}), "other")
    with pytest.raises(CalibrationError, match="same checkpoint; found .* instead of"):
        _require_same_policy(narrow, predicting(steps), "other")


def _point(name: str, latency: float, error: float) -> MeasuredPoint:
    return MeasuredPoint("s", name, error, latency, (0.0, 9.0), error, error, (latency, latency), 0.5, 1.0)


def test_the_frontier_is_what_nothing_beats() -> None:
    some = [_point("slow", 9, 0), _point("beaten", 5, 4), _point("good", 4, 2), _point("fast", 1, 7)]
    frontier = Comparison(tuple(some), 1, (0,), 1, 1.0, {}, ())
    assert [point.name for point in frontier.efficient()] == ["fast", "good", "slow"]
    assert [point["efficient"] for point in frontier.to_json()["points"]] == [True, False, True, True]


def test_the_picture_has_the_points_and_needs_a_folder(frontier: Comparison, tmp_path: Path) -> None:
    path = tmp_path / "f.png"
    figure = plot_frontier(frontier.points, frontier.efficient(), "title")
    write_picture(figure, path)
    with Image.open(path) as picture:
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20) or ()}
    assert {(0xD5, 0x5E, 0x00), (0x00, 0x72, 0xB2)} <= colours
    with pytest.raises(OutputError, match="folder that exists"):
        write_picture(figure, tmp_path / "none" / "f.png")


def test_bench_prints_the_same_as_a_table_and_as_json(
    planned: Path, other_sampler: Path, recording: Path, tmp_path: Path
) -> None:
    words = ["bench", planned, "--trajectories", recording, "--with", other_sampler, "--calls", 2]
    told = done(*words, "--json", "--plot", tmp_path / "f.svg")
    record = json.loads(told.stdout)
    labels = [one["label"] for one in record["contestants"]]
    assert labels == ["this artifact: dense", "this artifact: half", "five: dense"]
    points = record["comparison"]["points"]
    assert [f"{point['series']}: {point['name']}" for point in points] == labels
    assert points[1]["error"] > 1e-3 and points[0]["error"] < 1e-6  # of two runtimes
    assert points[2]["error"] is None  # another sampler takes other noise
    assert points[1]["distance"] > 1e-3 > points[0]["distance"]
    identity, other = (load_artifact(path).manifest.identity for path in (planned, other_sampler))
    assert record["identity"] == identity
    assert record["with"] == [{"path": str(other_sampler), "identity": other}]
    assert "held-out calls" in (tmp_path / "f.svg").read_text()
    assert "warning: this artifact" in told.stderr
    assert told.stderr.count("held-out calls: ") == 1  # a log has a line for each part of the work, and no bar
    lost = refused(*words, "--json", "--plot", tmp_path / "none" / "f.png")
    assert "held-out" not in lost, "refused before anything is computed"
    assert "folder" in lost
    shown = done(*words)
    text = " ".join(shown.stdout.split())
    assert "another sampler takes other noise, and has none" in text
    assert "in which two calls of the original are" in text
    assert f"five: identity {other[:12]}" in shown.stdout


def test_bench_judges_the_plans_that_are_named(planned: Path, other_sampler: Path, recording: Path) -> None:
    twins = shutil.copytree(planned, planned.parent / "three")
    store_schedules(twins, None, {name: uniform_plan(10, 6, 5) for name in ("half", "same")}, "half", {})
    words = ["bench", twins, "-t", recording, "--with", planned, "--calls", 2]

    def judged(*more: str) -> list[tuple[str, str]]:
        return [(point["series"], point["name"]) for point in as_json(*words, *more)["comparison"]["points"]]

    both = [("compiled", "dense"), ("compiled", "half")]
    this = [("this artifact", name) for name in ("dense", "half", "same")]
    assert judged() == this + both
    assert judged("--plan", "half") == this[:2] + both
    assert judged("--plan", "same") == [this[0], this[2], both[0]]
    assert "'quick'" in refused(*words, "--plan", "quick")
    assert "two artifacts are called 'three'" in refused(*words, "--with", twins, twins)


def test_where_a_plan_is_far_by_number_of_the_action_and_by_call(frontier: Comparison, recording: Path) -> None:
    dense, half = (points(frontier)["this artifact", name] for name in ("dense", "half"))
    assert len(half.by_number) == len(half.errors) == 2
    assert np.mean(half.errors) == pytest.approx(half.error, rel=1e-4) and max(dense.errors) < 1e-6
    assert half.by_number != pytest.approx((half.distance,) * 2) and max(dense.by_number) < 1e-3
    other = points(frontier)["five", "dense"]
    assert other.error is None and other.errors == (), "which has other noise"
    distances = [one.distance for one in half.furthest]
    assert len(distances) == 3 and distances == sorted(distances, reverse=True) and distances[0] > half.distance
    assert {one.episode for one in half.furthest} <= set(frontier.episodes)
    first = half.furthest[0]
    original, found = first.actions
    assert original.shape == found.shape == (4, 4, 2) and np.abs(original - found).max() > 1e-3
    assert sorted(first.numbers) == [0, 1], "first the one that is further off"
    told = json.loads(json.dumps(frontier.to_json()))["points"][1]
    assert told["furthest"][0] == {name: getattr(half.furthest[0], name) for name in ("episode", "call", "distance")}
    assert told["by_number"] == list(half.by_number)


def test_the_furthest_calls_have_what_the_cameras_saw_and_are_drawn(
    seen: tuple[Path, Path, dict[str, Any]], tmp_path: Path
) -> None:
    """Two artifacts of one checkpoint on one recording: ``bench A --with B -t FILE --plot``."""
    folder, recorded, views = seen
    other = shutil.copytree(folder, tmp_path / "other")
    far = compare(folder, [recorded], [other], calls=4).points[1].furthest[0]
    assert set(far.pictures) == set(cameras.CAMERAS)
    held_out = views[cameras.CAMERAS[0]][4 * far.episode + far.call, -1]
    np.testing.assert_allclose(far.pictures[cameras.CAMERAS[0]], held_out, atol=1e-6)
    words = ["bench", folder, "--with", other, "-t", recorded, "--calls", 1]
    result = done(*words, "--plot", tmp_path / "both.png")
    assert "furthest calls" in result.stdout
    assert f"episode {far.episode}, call" in result.stdout and "both-calls.png" in result.stderr
    with Image.open(tmp_path / "both-calls.png") as picture:
        assert picture.width > 2 * picture.height
