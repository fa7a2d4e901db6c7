"""Budgets: in which terms they can be given, what they come to, and when they are refused."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import budget as budgets, pipeline, schedule
from ttscompile.calibration.budget import Goal, cells_of, goal_of, measure_budget
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.pipeline import CalibrationResult, calibrate
from ttscompile.calibration.progress import Bar
from ttscompile.calibration.state import FILE, StateFile
from ttscompile.calibration.step_counts import SpacedSchedules, budget_of_error
from ttscompile.calibration.trials import Trials
from ttscompile.calibration.whole_steps import Errors, WholeSteps
from ttscompile.core.lattice import Source
from ttscompile.core.plan import Plan
from ttscompile.errors import CalibrationError, CalibrationFailedError
from ttscompile.measure.timer import Times

from . import policies
from .killed import killed
from .proposers.trying import trials_of

STEPS, BLOCKS = 10, 6


def quick(artifact: Path, recording: Path, **changes: Any) -> CalibrationResult:
    arguments: dict[str, Any] = {"progress": False, "max_intervals": 6, "max_minutes": 1, **changes}
    return calibrate(artifact, [recording], **arguments)


def test_nothing_asked_for_is_the_default_and_one_thing_is_itself() -> None:
    assert goal_of() == Goal("target_sparsity", 0.95)
    assert goal_of(target_flops=0.9).record() == {"target_flops": 0.9}
    assert goal_of(latency_ms=20, threads=2).record() == {"latency_ms": 20.0, "threads": 2}
    assert goal_of(max_action_error=3).record() == {"max_action_error": 3.0}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"target_sparsity": 0.9, "latency_ms": 5}, "found target_sparsity and latency_ms. They exclude each other"),
        ({"target_flops": 0.9, "max_action_error": 5}, "found target_flops and max_action_error"),
        ({"target_sparsity": 0}, "asks for the dense policy, which every artifact has"),
        ({"target_flops": 0.0}, "target_flops 0 asks for the dense policy"),
        ({"target_sparsity": 1.0}, "above 0 and below 1; found 1.0"),
        ({"target_sparsity": -0.1}, "above 0 and below 1; found -0.1"),
        ({"target_sparsity": float("nan")}, "above 0 and below 1; found nan"),
        ({"target_sparsity": "0.9"}, "found '0.9'"),
        ({"target_flops": 2}, "target_flops: expected a number above 0 and below 1"),
        ({"latency_ms": 0}, "latency_ms: expected a number above 0; found 0"),
        ({"latency_ms": float("inf")}, "latency_ms: expected a number above 0; found inf"),
        ({"max_action_error": -1}, "max_action_error: expected a number above 0"),
        ({"latency_ms": 5, "threads": 0}, "threads must be an integer of at least 1; found 0"),
    ],
)
def test_what_nothing_can_satisfy_is_refused_before_any_work(
    artifact: Path, recording: Path, asked: dict[str, Any], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        quick(artifact, recording, **asked)
    assert not (artifact / FILE).exists()


def test_less_than_a_whole_step_to_reuse_is_the_dense_policy(compiled: Path) -> None:
    manifest = load_artifact(compiled).manifest
    assert cells_of(goal_of(target_sparsity=0.1), manifest, pruned=False) == 54
    with pytest.raises(CalibrationError, match=r"leaves 55 of the 10 x 6 cells.*Ask for at least 0\.1\."):
        cells_of(goal_of(target_sparsity=0.08), manifest, pruned=False)


def test_flops_count_all_that_a_call_does(compiled: Path) -> None:
    manifest = load_artifact(compiled).manifest
    flops = manifest.flops
    fixed = flops.prologue + STEPS * (flops.stem + flops.tail)
    for full in (1, 3, 9):
        saved = 1 - (fixed + full * sum(flops.blocks)) / flops.dense
        assert cells_of(goal_of(target_flops=saved), manifest, pruned=False) == full * BLOCKS
        if full > 1:
            assert cells_of(goal_of(target_flops=saved), manifest, pruned=True) < full * BLOCKS


@pytest.mark.parametrize("target", [0.999, 0.97])
def test_more_flops_than_can_be_saved_are_refused(artifact: Path, recording: Path, target: float) -> None:
    with pytest.raises(CalibrationError, match=r"target flops .* cannot be reached: prologue.* at most 0\.\d+ can"):
        quick(artifact, recording, target_flops=target)


@pytest.mark.slow
def test_a_target_of_flops_is_kept_and_recorded(artifact: Path, recording: Path) -> None:
    result = quick(artifact, recording, target_flops=0.5)
    assert result.plans[result.default_plan].flops_saved >= 0.5
    record = load_artifact(artifact).manifest.calibration
    assert record is not None
    assert record["budget"] == {"target_flops": 0.5, "cells": result.budget["cells"]}
    one_more = result.plans["schedule"].flops_saved - 1 / STEPS
    assert one_more < 0.5  # another whole step would not fit


def measured(directory: Path, recording: Path, goal: Goal, pruned: bool) -> Goal:
    return measure_budget(trials_of(directory, [recording]), goal, pruned)


def _timed(monkeypatch: pytest.MonkeyPatch, step_ms: float) -> list[Plan]:
    """Calls take ``step_ms`` for each computed step; what was timed."""
    asked: list[Plan] = []

    def timed(entrants: Sequence[tuple[Trials, Plan]], threads: int) -> list[Times]:
        ((_, plan),) = entrants
        asked.append(plan)
        return [Times((float(step_ms * np.count_nonzero(plan.cells == Source.COMPUTE) / BLOCKS),))]

    monkeypatch.setattr(budgets, "timed", timed)
    monkeypatch.setattr(budgets, "_pruner_ms", lambda *_: 0.5)
    return asked


@pytest.mark.parametrize(("limit", "full"), [(1.0, 1), (3.4, 3), (9.9, 9)])
def test_a_latency_is_as_many_whole_steps_as_fit(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch, limit: float, full: int
) -> None:
    asked = _timed(monkeypatch, 1.0)
    budget = measured(artifact, recording, Goal("latency_ms", limit), pruned=False)
    assert budget.cells == full * BLOCKS
    assert budget.measured["measured_ms"][str(full)] == full
    assert len(asked) <= 6


def test_what_the_loop_waits_for_the_pruner_counts(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _timed(monkeypatch, 1.0)
    budget = measured(artifact, recording, Goal("latency_ms", 3.4), pruned=True)
    assert budget.cells == 2 * BLOCKS


@pytest.mark.parametrize(
    ("limit", "message"), [(0.9, "a call that computes step 0 alone takes 1 ms"), (10.0, "is met by the dense policy")]
)
def test_a_latency_out_of_reach_is_refused(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch, limit: float, message: str
) -> None:
    _timed(monkeypatch, 1.0)
    with pytest.raises(CalibrationError, match=message):
        measured(artifact, recording, Goal("latency_ms", limit), pruned=False)


def test_the_real_clock_finds_that_nothing_takes_no_time(artifact: Path, recording: Path) -> None:
    """Which is the answer of a measurement, and no bad input: exit status 1, as where loops are learned."""
    with pytest.raises(
        CalibrationFailedError, match=r"latency ms 0\.0001 cannot be reached: .* on this machine with 2 threads"
    ):
        quick(artifact, recording, latency_ms=0.0001, threads=2)


@pytest.mark.slow
def test_the_latency_is_measured_once(artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _timed(monkeypatch, 1.0)
    with killed(saves=5):  # of the original's answers, of the latency, and of some targets
        quick(artifact, recording, latency_ms=3.9)
    monkeypatch.setattr(schedule, "measure_budget", lambda *_: pytest.fail("measured again"))
    result = quick(artifact, recording, latency_ms=3.9, resume=True)
    assert result.budget["cells"] == 3 * BLOCKS
    assert result.budget["latency_ms"] == 3.9
    assert result.budget["measured_ms"]["3"] == 3.0  # the pruner is not part of it
    assert np.count_nonzero(load_artifact(artifact).plans["schedule"].cells == Source.COMPUTE) == 3 * BLOCKS


class _Judged(WholeSteps):
    """Schedules of 100 steps, whose error is one over the number of those that they compute."""

    steps = 100

    def __init__(self) -> None:
        self.asked: list[tuple[int, ...]] = []

    def correcting(self, full_steps: int) -> float:
        return 0.0

    def expect(self, schedules: Any) -> None:
        pass

    def errors(self, steps: Any) -> Errors:
        self.asked.append(tuple(steps))
        return Errors(1 / len(steps), 10 / len(steps))


@pytest.mark.parametrize(("limit", "full"), [(10.0, 1), (4.9, 3), (1.0, 10), (0.85, 12), (0.2, 50)])
def test_an_error_is_as_few_steps_as_do(tmp_path: Path, limit: float, full: int) -> None:
    whole, state = _Judged(), StateFile(tmp_path, {})
    with Bar(shown=False) as bar:
        crowded = SpacedSchedules(whole, state, Clock(), bar)
        budget = budget_of_error(crowded, Goal("max_action_error", limit), 100, BLOCKS)
        assert budget.cells == full * BLOCKS
        asked = len(whole.asked)
        assert budget_of_error(crowded, Goal("max_action_error", limit), 100, BLOCKS) == budget
        assert len(whole.asked) == asked  # remembered


def test_an_error_out_of_reach_and_one_out_of_time_are_failures(tmp_path: Path) -> None:
    with Bar(shown=False) as bar:
        crowded = SpacedSchedules(_Judged(), StateFile(tmp_path, {}), Clock(), bar)
        with pytest.raises(CalibrationFailedError, match="at least half of the cells: 10 with 1 of .*, 0.2 with 50 of"):
            budget_of_error(crowded, Goal("max_action_error", 0.1), 100, BLOCKS)
        late = SpacedSchedules(_Judged(), StateFile(tmp_path, {}), Clock(0.0), bar)
        with pytest.raises(CalibrationFailedError, match="time limit ended the search .*: none tried"):
            budget_of_error(late, Goal("max_action_error", 0.1), 100, BLOCKS)


@pytest.mark.slow
def test_an_error_is_kept_on_held_out_episodes(artifact: Path, recording: Path) -> None:
    loose = quick(artifact, recording, max_action_error=0.05)
    error = policies.errors(loose)[loose.default_plan]
    assert error <= 0.05
    strict = quick(artifact, recording, max_action_error=0.6 * error)
    assert policies.errors(strict)[strict.default_plan] <= 0.6 * error
    assert strict.sparsity < loose.sparsity
    assert strict.budget["max_action_error"] == 0.6 * error


def test_of_one_step_nothing_can_be_reused(artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = load_artifact(artifact)
    sampler = loaded.manifest.spec.sampler
    rows: dict[str, Any] = {name: np.ascontiguousarray(getattr(sampler, name)[:1]) for name in sampler.COLUMNS}
    one = replace(sampler, timesteps=sampler.timesteps[:1].copy(), **rows)
    single = replace(loaded, manifest=replace(loaded.manifest, spec=replace(loaded.manifest.spec, sampler=one)))
    monkeypatch.setattr(pipeline, "load_artifact", lambda _: single)
    for asked in ({"max_action_error": 1.0}, {"latency_ms": 1.0}, {"target_sparsity": 0.5}, {}):
        with pytest.raises(CalibrationError, match="one denoising step, which every plan computes"):
            quick(artifact, recording, **asked)


def test_an_error_needs_a_proposer_that_fits_corrections(artifact: Path, recording: Path) -> None:
    with pytest.raises(CalibrationError, match="expected a proposer that fits corrections, 'schedule'; found 'bac'"):
        quick(artifact, recording, max_action_error=1.0, learn=("bac",))
