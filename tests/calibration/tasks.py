"""Tasks on the small policies, without the rest of calibration."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import Calls, load_episodes, prepare_calls, sample_calls
from ttscompile.calibration.proposer import ScheduleRow
from ttscompile.calibration.proposers import rows_of
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.schedule import search_plan
from ttscompile.calibration.state import StateFile
from ttscompile.calibration.task import Found, Task
from ttscompile.calibration.trials import Trials
from ttscompile.measure.points import pairs, rooted
from ttscompile.trajectories import load_trajectories
from ttscompile.trajectories.episodes import Episode

WINDOW = 4

MakeTask = Callable[..., Task]
"""``make_task`` on the nonlinear policy."""


def make_task(
    directory: Path, recording: Path, budget: int = 20, calls: int = 12, seed: int = 0, episodes: range = range(6)
) -> Task:
    """A task with all that a search may ask for."""
    artifact = load_artifact(directory)
    spec, runner = artifact.manifest.spec, Runner(view_of(artifact, "dense"))
    recorded = load_trajectories([recording], spec.observations, 4)
    chosen = sample_calls(recorded, episodes, calls, seed=0, repeats=100)
    prepared = prepare_calls(runner.model, spec, recorded, chosen, (0, episodes.start))
    prepared = replace(prepared, path=runner.run_dense(prepared))
    return Task.of(runner, prepared, budget, seed)


def trials_of(directory: Path, recording: Path, state: Path, **fields: Any) -> Trials:
    """Of an artifact; what they find out is kept in the folder ``state``."""
    artifact = load_artifact(directory)
    episodes = load_episodes(artifact.manifest.spec, [recording], None)
    return Trials.of(artifact, episodes, StateFile(state, {}), **fields)


def distance(x: np.ndarray, y: np.ndarray) -> float:
    """Of answers to the same observations, as plans are judged by it."""
    h, apart = pairs(x, y)
    return rooted(float(h.mean()), float(apart.mean()))


def row_of(name: str) -> ScheduleRow:
    """Of what makes a schedule."""
    (row,) = rows_of((name,))
    assert isinstance(row, ScheduleRow)
    return row


def found_by(name: str, task: Task, intervals: int | None = None) -> Found:
    """What the search of a row finds."""
    return search_plan(row_of(name).search(task), task.clock, intervals)[0]


def in_windows(task: Task, windows: int, window: int = WINDOW) -> Calls:
    """Consecutive calls of made-up episodes, with targets."""
    spec, model = task.runner.view.manifest.spec, task.runner.model
    walk = np.cumsum(np.random.default_rng(5).standard_normal((windows, window, 2, 3)), 1).astype(np.float32)
    episodes = [Episode("made up", {"obs": one}) for one in walk]
    chosen = [(n, row) for n in range(windows) for row in range(window)]
    calls = prepare_calls(model, spec, episodes, chosen, (0, 9), window)
    return replace(calls, path=task.runner.run_dense(calls))
