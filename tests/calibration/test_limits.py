"""The time limit, seeds, and errors that are no numbers: what a calibration does at its edges."""

import errno
import os
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from ttscompile import ObservationSpec
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration import arguments, targets
from ttscompile.calibration.arguments import MOST_CALLS, MOST_LEARNED, calls_to_learn_from
from ttscompile.calibration.budget import _pruner_ms
from ttscompile.calibration.calls import Actions, split_episodes
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.compare import compare
from ttscompile.calibration.pipeline import calibrate
from ttscompile.calibration.progress import Bar
from ttscompile.calibration.proposers import SCHEDULES
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.schedule import search_plan
from ttscompile.calibration.state import FILE, StateFile
from ttscompile.calibration.step_counts import SpacedSchedules
from ttscompile.calibration.targets import draw_calls, with_targets
from ttscompile.calibration.trials import ANSWERED_BY
from ttscompile.core.lattice import Source, uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.errors import CalibrationError, CalibrationFailedError
from ttscompile.measure.points import LARGEST
from ttscompile.pool import Here
from ttscompile.runtimes.reference.model import Contexts, ReferenceModel
from ttscompile.runtimes.runtime import Runtime
from ttscompile.trajectories import load_trajectories

from . import policies
from .tasks import MakeTask, row_of


class _Hand(Clock):
    """A clock that is moved by hand."""

    now = 0.0

    def elapsed(self) -> float:
        return self.now


class _Slow:
    """A search whose intervals take 10 s, and whose plan takes 25 s more to be finished."""

    intervals, seconds_to_finish, done = 50, 25.0, False

    def __init__(self, clock: _Hand) -> None:
        self._clock = clock

    def advance(self, interval: int) -> None:
        self._clock.now += 10

    def found(self) -> str:
        self._clock.now += self.seconds_to_finish
        return "found"


def test_the_search_ends_in_time_for_what_its_plan_still_takes() -> None:
    clock = _Hand(100.0)
    search: Any = _Slow(clock)
    told: tuple[Any, int, str] = search_plan(search, clock)
    assert told == ("found", 7, "time limit")
    assert clock.now == 95.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "limit"), [*((row.name, 0) for row in SCHEDULES), ("teacache", 1920), ("delta-dit", 960)]
)
def test_a_limit_holds_within_an_interval(
    make_task: MakeTask, name: str, limit: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A block takes a second for each call: a dense answer to all calls takes 480.

    At least a search makes two plans; one that fits corrections also decides whether they read the observation, and one
    that trains compares what it starts from.
    """
    task, clock, block = make_task(budget=34, calls=8), _Hand(limit), ReferenceModel.block

    def slow(self: ReferenceModel, b: int, k: int, stream: Any, contexts: Contexts, *streams: Any) -> torch.Tensor:
        clock.now += len(streams[0]) if streams and streams[0] is not None else contexts.streams
        return block(self, b, k, stream, contexts, *streams)

    monkeypatch.setattr(ReferenceModel, "block", slow)
    search = row_of(name).search(replace(task, clock=clock))
    if name in ("teacache", "dbcache") and limit == 0:
        with pytest.raises(CalibrationFailedError, match="time limit ended the search for a threshold of"):
            search_plan(search, clock)
    else:
        found, _, stopped = search_plan(search, clock)
        assert np.count_nonzero(found.schedule == Source.COMPUTE) <= 34
        assert (stopped == "time limit") == (name not in ("interval", "deepcache"))  # which have one candidate
    more = row_of(name).corrects or row_of(name).uses_pruner
    assert clock.now <= limit + (2 + more) * 480


def test_a_family_is_not_begun_that_cannot_be_finished(make_task: MakeTask, tmp_path: Path) -> None:
    """Compared, then fitted on all calls, without jumps and with them, and judged."""
    whole = make_task(20, calls=24).whole
    assert whole.comparing(3) == whole.correcting(3) == 0.0  # nothing is known yet
    begun = time.monotonic()
    whole.errors((0, 4, 8))
    pace = whole.comparing(1)
    assert 0 < 3 * pace <= time.monotonic() - begun
    assert whole.correcting(1) == pytest.approx((1 + 2 * 24 / (18 + 2 * 6)) * pace)
    needed = 2 * whole.comparing(4) + whole.correcting(4)
    with Bar(shown=False) as bar:
        for limit, made in ((0.9 * needed, False), (1.1 * needed, True)):
            crowded = SpacedSchedules(whole, StateFile(tmp_path, {}), _Hand(limit), bar)
            assert (crowded.best(4, "", (2.0,)) is not None) == made


def test_when_half_of_the_time_is_over_no_more_targets_are_made_than_needed(
    compiled: Path, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(targets, "TARGETS_AT_ONCE", 2)
    artifact = load_artifact(compiled)
    runner, spec = Runner(view_of(artifact, "dense")), artifact.manifest.spec
    episodes = load_trajectories([recording], spec.observations, 4)
    calls = draw_calls(runner, episodes, split_episodes(6, 0.25, 0), 16, 0)
    state, fresh, clock = StateFile(tmp_path, {}), StateFile(tmp_path, {}), _Hand(100.0)
    clock.now = 51.0
    with Bar(shown=False) as bar:
        few = with_targets(runner, "calibration", calls, 3, state, clock.until(ANSWERED_BY), bar, Here())
        assert few.count == min(max(4, 2 * torch.get_num_threads()), 16)  # whole rounds, a worker's part is two calls
        clock.now = 0.0
        # As after an interruption.
        again = with_targets(runner, "calibration", calls, 3, state, clock.until(ANSWERED_BY), bar, Here())
        whole = with_targets(runner, "calibration", calls, 3, fresh, clock.until(ANSWERED_BY), bar, Here())
    assert (again.count, whole.count) == (few.count, calls.count)
    assert few.path is not None
    assert whole.path is not None
    torch.testing.assert_close(few.path, whole.path[: few.count], rtol=0, atol=0)
    np.testing.assert_array_equal(few.episodes, calls.episodes[: few.count])


def test_only_corrections_need_many_calls(artifact: Path, recording: Path) -> None:
    result = calibrate(artifact, [recording], 0.7, learn=("interval",), progress=False, max_minutes=1e-6)
    assert result.calls["calibration"] == 64


def test_errors_that_are_no_numbers_are_large_ones(compiled: Path) -> None:
    actions = Actions(load_artifact(compiled).manifest.spec)
    samples = torch.zeros(3, policies.HORIZON, policies.CHANNELS)
    samples[0] = float("nan")
    samples[1] = -float("inf")
    for units in (False, True):
        errors = actions.errors(samples, torch.zeros_like(samples), units)
        np.testing.assert_array_equal(errors, np.array([LARGEST, LARGEST, 0], np.float32))


def test_a_baseline_that_diverges_is_worse_than_any_plan(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    predict = Runtime.predict

    def diverging(self: Runtime, obs: Any, noise: Any, plan: Plan, prefix: Any = None) -> Any:
        sample, report = predict(self, obs, noise, plan, prefix)
        fails = plan.cells is not None and np.array_equal(plan.cells, uniform_plan(10, 6, 5))
        return sample * float("nan") if fails else sample, report

    monkeypatch.setattr(Runtime, "predict", diverging)
    result = calibrate(artifact, [recording], 0.55, learn=("deepcache",), progress=False, max_minutes=1e-6)
    error = policies.errors(result)
    assert error["uniform"] == pytest.approx(LARGEST)
    assert error[result.default_plan] < 1
    record = load_artifact(artifact).manifest.calibration or {}
    assert record["plans"]["uniform"]["error"] == pytest.approx(LARGEST)


def test_a_negative_seed_is_refused(artifact: Path, recording: Path) -> None:
    with pytest.raises(CalibrationError, match="seed must be an integer of at least 0; found -1"):
        calibrate(artifact, [recording], 0.7, seed=-1, progress=False)
    with pytest.raises(CalibrationError, match="found -1"):
        compare(artifact, [recording], seed=-1)
    wrong: dict[str, Any]
    for name in ("seed", "threads", "max_intervals"):
        wrong = {name: 0.5}
        with pytest.raises(CalibrationError, match=f"{name} must be an integer of at least .; found 0.5"):
            calibrate(artifact, [recording], 0.7, **wrong, progress=False)
    with pytest.raises(CalibrationError, match="max_intervals must be an integer of at least 1; found 0"):
        calibrate(artifact, [recording], 0.7, max_intervals=0, progress=False)
    for name in ("calls", "seed", "threads"):
        wrong = {name: True}
        with pytest.raises(CalibrationError, match=f"{name} must be an integer of at least .; found True"):
            compare(artifact, [recording], **wrong)


def test_a_state_that_cannot_be_removed_is_an_error(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read_only(self: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(self))

    monkeypatch.setattr(Path, "unlink", read_only)
    with pytest.raises(CalibrationError, match=f"{FILE}: cannot be removed.*Read-only"):
        calibrate(artifact, [recording], 0.7, progress=False)


def test_a_full_disk_leaves_the_state_that_was_saved_and_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = StateFile(tmp_path, {})
    state.save(calls=3)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("ttscompile.artifact.files.write_synced", full)
    with pytest.raises(CalibrationError, match="No space left.* as it was: make room, and go on .* with --resume"):
        state.save(calls=4)
    again = StateFile(tmp_path, {})
    assert again.load() and again.progress == {"calls": 3}
    assert [path.name for path in tmp_path.iterdir()] == [FILE]


def test_an_artifact_that_cannot_be_written_is_refused_before_any_work(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: path != artifact)  # whoever is root may write everywhere
    with pytest.raises(CalibrationError, match="nothing can be written there"):
        calibrate(artifact, [recording])


def test_the_pruner_is_timed_with_observations_as_the_network_takes_them(compiled: Path) -> None:
    artifact = load_artifact(compiled)
    observations = {"obs": artifact.manifest.spec.observations["obs"], "tokens": ObservationSpec((4,), dtype="int64")}
    manifest = replace(artifact.manifest, spec=replace(artifact.manifest.spec, observations=observations))
    given: list[dict[str, Any]] = []

    def predict(obs: dict[str, Any], noise: Any, plan: Plan) -> tuple[None, Any]:
        assert plan.pruned
        given.append({key: str(value.dtype) for key, value in obs.items()})
        return None, SimpleNamespace(timings=SimpleNamespace(wait_pruner=0.25))

    runtime: Any = SimpleNamespace(predict=predict, reset=lambda: None)
    assert _pruner_ms(manifest, runtime, artifact.plans["dense"]) == 0.25
    assert given[0] == {"obs": "float32", "tokens": "int64"}


def test_a_network_learns_from_more_calls_where_their_contexts_fit(
    compiled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = load_artifact(compiled).manifest
    assert calls_to_learn_from(manifest, 1e6, corrects=False)[1] == MOST_CALLS
    assert calls_to_learn_from(manifest, 1e6, corrects=True)[1] == MOST_LEARNED
    assert calls_to_learn_from(manifest, 1e6, corrects=False, trains=True)[1] == MOST_LEARNED
    large = replace(manifest, spec=replace(manifest.spec, sample=(513, 2)))
    assert calls_to_learn_from(large, 1e6, corrects=True)[1] == MOST_CALLS
    monkeypatch.setattr(arguments, "ROOM", 5000 * arguments._context_bytes(manifest))
    assert calls_to_learn_from(manifest, 1e6, corrects=True)[1] == 5000
    monkeypatch.setattr(arguments, "ROOM", 1)
    assert calls_to_learn_from(manifest, 1e6, corrects=True)[1] == MOST_CALLS
