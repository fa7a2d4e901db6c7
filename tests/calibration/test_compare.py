"""The comparison of strategies, plans and artifacts: what it measures, and what it refuses to compare."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from PIL import Image

import ttscompile
from tests.families import cameras
from tests.once import Once
from tests.plans import store_schedules
from ttscompile import SamplerTable
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.calibration.calls import Calls
from ttscompile.calibration.compare import _require_same_policy, compare
from ttscompile.calibration.execute import Executor
from ttscompile.calibration.saved_searches import Searches
from ttscompile.calibration.search import plan_of
from ttscompile.calibration.state import StateFile
from ttscompile.calibration.task import Found, Task
from ttscompile.calibration.trials import DRAWS
from ttscompile.cli import main
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import TokenReuse
from ttscompile.errors import CalibrationError, OutputError
from ttscompile.measure.points import Comparison, MeasuredPoint
from ttscompile.plots.frontier import plot_frontier

from . import policies

pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def planned(compiled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small policy with a plan, ``half``."""
    directory = tmp_path_factory.mktemp("planned") / "compiled"
    shutil.copytree(compiled, directory)
    record = {"episodes": {"validation": [0, 1]}}
    store_schedules(directory, None, {"half": uniform_plan(10, 6, 5)}, "half", record)
    return directory


@pytest.fixture(scope="session")
def other_sampler(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same network with a deterministic sampler of five steps."""
    spec = policies.spec(noise=0.0)
    rows = {name: np.ascontiguousarray(getattr(spec.sampler, name)[::2]) for name in SamplerTable.COLUMNS}
    sampler = replace(spec.sampler, name="five", timesteps=spec.sampler.timesteps[::2].copy(), **rows)
    directory = tmp_path_factory.mktemp("five") / "five"
    ttscompile.compile_denoiser(policies.Mixer(0).eval(), replace(spec, sampler=sampler), directory)
    return directory


@pytest.fixture(scope="session")
def frontier(planned: Path, other_sampler: Path, recording: Path) -> Comparison:
    return compare(planned, [recording], ["interval", "tts"], [0.5, 0.8], [other_sampler], calls=8, intervals=8)


def points(frontier: Comparison) -> dict[tuple[str, str], MeasuredPoint]:
    return {(point.series, point.name): point for point in frontier.points}


def test_every_plan_is_measured_on_the_same_calls(frontier: Comparison) -> None:
    found = points(frontier)
    assert list(found) == [
        ("this artifact", "dense"),
        ("this artifact", "half"),
        ("interval", "0.5"),
        ("interval", "0.8"),
        ("tts", "0.5"),
        ("tts", "0.8"),
        ("five", "dense"),
    ]
    dense = found["this artifact", "dense"]
    assert (dense.error or 0.0) < 1e-6  # the truth, with the same noise, in another runtime
    assert dense.distance == pytest.approx(0.0, abs=1e-3)
    half, same = found["this artifact", "half"], found["interval", "0.5"]
    assert (half.error, half.distance) == (same.error, same.distance)  # one plan under two names
    assert half.sparsity == same.sparsity == 0.5
    assert found["interval", "0.8"].error != same.error
    tts, interval = found["tts", "0.8"], found["interval", "0.8"]
    assert (tts.error or 1.0) < (interval.error or 0.0)  # its correction is there
    assert tts.distance < interval.distance
    assert all(point.latency_ms > 0 for point in found.values())
    assert {point.series for point in frontier.points if point.error is None} == {"five"}  # which has other noise
    assert found["five", "dense"].distance > 0.1
    assert all(point.interval[0] <= point.distance <= point.interval[1] for point in frontier.points)
    assert frontier.other_noise > 0.01
    assert frontier.calls == 8


def test_rivals_take_part_with_a_correction_of_their_own(planned: Path, recording: Path) -> None:
    found = points(compare(planned, [recording], ["interval"], [0.5], calls=8, learned=400, correct=True))
    plain, corrected = found["interval", "0.5"], found["interval, corrected", "0.5"]
    assert corrected.sparsity == plain.sparsity
    assert (corrected.error or 1.0) < 0.7 * (plain.error or 0.0)
    assert corrected.distance < 0.7 * plain.distance


def test_a_plan_that_cannot_be_corrected_is_left_out_with_the_reason(
    planned: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Task, found: Found) -> Found:
        raise CalibrationError("reads residuals of earlier calls")

    monkeypatch.setattr(Task, "corrected", refuse)
    found = compare(planned, [recording], ["interval"], [0.5], calls=4, correct=True)
    assert found.skipped == {"interval, corrected 0.5": "reads residuals of earlier calls"}
    assert ("interval", "0.5") in points(found)


def test_it_says_where_plans_may_have_been_learned_from_these_episodes(planned: Path, frontier: Comparison) -> None:
    assert len(frontier.warnings) == 1
    assert frontier.warnings[0].startswith(
        "this artifact: its calibration held out the episodes [0, 1], and this comparison"
    )


def test_nothing_is_written(planned: Path, recording: Path) -> None:
    before = {path.name: path.read_bytes() for path in planned.iterdir()}
    compare(planned, [recording], ["interval"], [0.5], calls=1)
    assert {path.name: path.read_bytes() for path in planned.iterdir()} == before


class Gone(Exception):
    """Stands for whatever ends a comparison: nothing of the package catches it."""


def interrupted_after(searches: int, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The next comparison ends when it begins another search; the strategies of all searches since."""
    begun = list[str]()

    def search(strategy: str, *arguments: Any) -> Any:
        if len(begun) == searches:
            raise Gone
        begun.append(strategy)
        return plan_of(strategy, *arguments)

    monkeypatch.setattr("ttscompile.calibration.compare.plan_of", search)
    return begun


def test_an_interrupted_comparison_goes_on_to_the_same_outcome(
    planned: Path, frontier: Comparison, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def again(**options: Any) -> Comparison:
        return compare(planned, [recording], ["interval", "tts"], [0.5, 0.8], calls=8, intervals=8, **options)

    interrupted_after(3, monkeypatch)
    with pytest.raises(Gone):
        again()
    assert (planned / "comparison-state.safetensors").exists()
    assert ttscompile.load(planned).info.identity == load_artifact(planned).manifest.identity  # it is no part of it
    with pytest.raises(CalibrationError, match="the comparison that was interrupted had other settings: seed was 0"):
        again(seed=1, resume=True)

    answer, answered = Executor.run_dense, list[int]()

    def counting(self: Executor, calls: Calls) -> torch.Tensor:
        answered.append(calls.count)
        return answer(self, calls)

    monkeypatch.setattr(Executor, "run_dense", counting)
    begun = interrupted_after(9, monkeypatch)
    found, expected = points(again(resume=True)), points(frontier)
    assert begun == ["tts"]
    assert sum(answered) == 8 * DRAWS, "what is learned from is known"
    for key, point in found.items():
        assert replace(point, latency_ms=0.0, quartiles_ms=(0.0, 0.0)) == replace(
            expected[key], latency_ms=0.0, quartiles_ms=(0.0, 0.0)
        )
    assert not (planned / "comparison-state.safetensors").exists()


def test_without_resume_it_begins_anew(planned: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupted_after(1, monkeypatch)
    with pytest.raises(Gone):
        compare(planned, [recording], ["interval"], [0.5, 0.8], calls=1)
    begun = interrupted_after(9, monkeypatch)
    compare(planned, [recording], ["interval"], [0.5, 0.8], calls=1)
    assert begun == ["interval", "interval"]


def test_why_there_is_no_plan_is_kept_too_and_a_damaged_state_is_refused(
    planned: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def again() -> Comparison:
        return compare(planned, [recording], ["deepcache", "interval"], [0.8], calls=1, resume=True)

    interrupted_after(1, monkeypatch)
    with pytest.raises(Gone):
        again()
    state = planned / "comparison-state.safetensors"
    content = state.read_bytes()
    state.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(CalibrationError, match="Compare again without --resume: that begins anew"):
        again()
    state.write_bytes(content)
    begun = interrupted_after(9, monkeypatch)
    assert "computes at least 24" in again().skipped["deepcache 0.8"]
    assert begun == ["interval"]


@pytest.mark.parametrize(
    "searches",
    [
        [],
        {"interval 12": []},
        {"interval 12": {"interval": 3}},
        {"interval 12": {"interval": {"notes": {}, "error": "x", "cut": 0}}},
    ],
)
def test_a_state_that_was_forged_is_refused(tmp_path: Path, searches: Any) -> None:
    def resumed() -> None:
        state = StateFile(tmp_path, {}, "comparison")
        assert state.load()
        Searches(state, (10, 6)).known("interval", 12)

    state = StateFile(tmp_path, {}, "comparison")
    state.save()
    resumed()
    state.progress = {"searches": searches}
    state.save()
    with pytest.raises(CalibrationError, match="does not fit this comparison .* Compare again without --resume"):
        resumed()


def test_a_zipped_artifact_is_compared_and_keeps_nothing(planned: Path, recording: Path, tmp_path: Path) -> None:
    zipped = Path(shutil.make_archive(str(tmp_path / "compiled"), "zip", planned))
    found = compare(zipped, [recording], ["interval"], [0.5], calls=1)
    assert "nothing was kept for --resume: its artifact is no directory." in found.warnings
    assert [path.name for path in tmp_path.iterdir()] == ["compiled.zip"]


def test_it_says_when_a_search_had_too_little_time_or_too_few_calls(planned: Path, recording: Path) -> None:
    found = compare(planned, [recording], ["tts", "interval", "teacache"], [0.8], calls=1, learned=8, max_minutes=0)
    assert [point.series for point in found.points] == ["this artifact"] * 2 + ["tts", "interval"]
    assert found.skipped["teacache 0.8"].startswith("the time limit ended the search for a threshold of 'teacache'")
    assert found.warnings[1] == "the limit of 0 minutes cut the search short of tts 0.8: see --max-minutes."
    assert "tts fits corrections of 48 features from at most 8 calls" in found.warnings[2]


def test_it_says_who_does_not_take_part_as_he_is(planned: Path, recording: Path) -> None:
    found = compare(planned, [recording], ["tts-paper"], [0.5], calls=1, learned=8, intervals=1)
    assert [point.series for point in found.points] == ["this artifact"] * 2 + ["tts-paper"]
    assert found.warnings[1].startswith("tts-paper: one plan for all calls takes part")
    found = compare(planned, [recording], ["interval"], [], calls=1)
    assert found.warnings[1] == "no strategy takes part: no share of the cells was given for K = 10."


def test_the_truth_has_all_tokens(once: Once, tmp_path: Path) -> None:
    """With a threshold that nothing passes the newest of two frames is taken for the one before."""

    def make(folder: Path) -> None:
        ttscompile.compile_denoiser(*cameras.policy("clip"), folder / "artifact")

    folder, draw = shutil.copytree(once.folder("tokens in fp32", make) / "artifact", tmp_path / "own"), np.random
    views = {key: draw.default_rng(0).random((8, 2, 3, cameras.SIDE, cameras.SIDE)) for key in cameras.CAMERAS}
    recorded = tmp_path / "calls.npz"
    np.savez(recorded, state=np.zeros((8, 2, 4), np.float32), episode_ends=np.array([4, 8]), **views)
    dense = load_artifact(folder).plans["dense"]
    update_plans(folder, {"reusing": replace(dense, tokens=TokenReuse(100.0, 64))}, "reusing")
    whole, reusing = compare(folder, [recorded], [], [], calls=4).points
    assert (whole.error or 0.0) < 1e-5 < (reusing.error or 0.0)
    assert whole.distance < reusing.distance


def test_a_strategy_that_cannot_reach_a_sparsity_is_left_out_with_the_reason(planned: Path, recording: Path) -> None:
    found = compare(planned, [recording], ["deepcache"], [0.8], calls=1)
    assert {point.series for point in found.points} == {"this artifact"}
    assert "computes at least 24 of the 10 x 6 cells" in found.skipped["deepcache 0.8"]


def test_what_cannot_be_compared_is_refused(
    planned: Path, linear_policy: Path, recording: Path, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError, match="same checkpoint; found other weights"):
        compare(planned, [recording], [], [], [linear_policy])
    with pytest.raises(CalibrationError, match=f"two artifacts are called '{planned.name}'"):
        compare(planned, [recording], [], [], [planned, shutil.copytree(planned, tmp_path / planned.name)])
    with pytest.raises(CalibrationError, match="'magic'; expected one of tts"):
        compare(planned, [recording], ["magic"], [0.5])
    with pytest.raises(CalibrationError, match=r"at most 0\.9 of the 10 x 6"):
        compare(planned, [recording], ["tts"], [0.95])
    with pytest.raises(CalibrationError, match="one episode; expected at least two"):
        compare(planned, [policies.record(tmp_path / "one.npz", episodes=1)], [], [])


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
    return MeasuredPoint("s", name, error, (0.0, 9.0), error, error, latency, (latency, latency), 0.5, 1.0)


def test_the_frontier_is_what_nothing_beats() -> None:
    some = [_point("slow", 9, 0), _point("beaten", 5, 4), _point("good", 4, 2), _point("fast", 1, 7)]
    frontier = Comparison(tuple(some), 1, (0,), 1, 1.0, {}, ())
    assert [point.name for point in frontier.efficient()] == ["fast", "good", "slow"]
    assert [point["efficient"] for point in frontier.to_json()["points"]] == [True, False, True, True]


def test_the_picture_has_the_points_and_needs_a_folder(frontier: Comparison, tmp_path: Path) -> None:
    path = tmp_path / "f.png"
    arguments: tuple[Any, ...] = [p.point for p in frontier.points], [p.point for p in frontier.efficient()]
    plot_frontier(*arguments, path, "title")
    with Image.open(path) as picture:
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20)}
    assert {(0xD5, 0x5E, 0x00), (0x00, 0x72, 0xB2), (0x00, 0x9E, 0x73)} <= colours
    with pytest.raises(OutputError, match="folder that exists"):
        plot_frontier(*arguments, tmp_path / "none" / "f.png", "title")


def test_bench_prints_the_same_as_a_table_and_as_json(
    planned: Path, other_sampler: Path, recording: Path, tmp_path: Path
) -> None:
    arguments = [str(planned), "--trajectories", str(recording), "--with", str(other_sampler), "--calls", "2"]
    runner = CliRunner()
    told = runner.invoke(main, ["bench", *arguments, "--json", "--plot", str(tmp_path / "f.svg")])
    assert told.exit_code == 0, told.stderr
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
    assert told.stderr.count("held-out calls\n") == 1  # a log has a line for each part of the work, and no bar
    lost = runner.invoke(main, ["bench", *arguments, "--json", "--plot", str(tmp_path / "none" / "f.png")])
    assert lost.exit_code == 2
    assert lost.stdout == ""
    assert "held-out" not in lost.stderr, "refused before anything is computed"
    assert "folder" in lost.stderr
    shown = runner.invoke(main, ["bench", *arguments])
    assert shown.exit_code == 0, shown.stderr
    words = " ".join(shown.stdout.split())
    assert "another sampler takes other noise, and has none" in words
    assert "in which two calls of the original are" in words
    assert f"five: identity {other[:12]}" in shown.stdout


def test_bench_judges_the_plans_that_are_named(planned: Path, other_sampler: Path, recording: Path) -> None:
    twins = shutil.copytree(planned, planned.parent / "three")
    store_schedules(twins, None, {name: uniform_plan(10, 6, 5) for name in ("half", "same")}, "half", {})
    words = ["bench", str(twins), "-t", str(recording), "--with", str(planned), "--calls", "2", "--json"]

    def judged(*more: str) -> list[tuple[str, str]]:
        told = CliRunner().invoke(main, [*words, *more])
        assert told.exit_code == 0, told.stderr
        return [(point["series"], point["name"]) for point in json.loads(told.stdout)["comparison"]["points"]]

    both = [("compiled", "dense"), ("compiled", "half")]
    this = [("this artifact", name) for name in ("dense", "half", "same")]
    assert judged() == this + both
    assert judged("--plan", "half") == this[:2] + both
    assert judged("--plan", "same") == [this[0], this[2], both[0]]
    refused = CliRunner().invoke(main, [*words, "--plan", "quick"])
    assert refused.exit_code == 2 and "'quick'" in refused.stderr
    again = CliRunner().invoke(main, [*words, "--with", str(twins), str(twins)])
    assert again.exit_code == 2 and "two artifacts are called 'three'" in again.stderr
