"""Tasks on the small policies, without the rest of calibration."""

from __future__ import annotations

from pathlib import Path

from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.calls import Actions, prepare_calls, sample_calls
from ttscompile.calibration.execute import Executor
from ttscompile.calibration.strategies import Task
from ttscompile.trajectories import load_trajectories


def make_task(directory: Path, recording: Path, budget: int, calls: int = 12, seed: int = 0) -> Task:
    """A task with all that a strategy may ask for."""
    artifact = load_artifact(directory)
    spec, executor = artifact.manifest.spec, Executor(artifact)
    episodes = load_trajectories([recording], spec.observations, 4)
    chosen = sample_calls(episodes, range(len(episodes)), calls, seed=0)
    prepared = prepare_calls(executor.model, spec, episodes, chosen, (0, 0))
    prepared = prepared.answered(executor.run_dense(prepared))
    kinds = tuple(block.kind for block in artifact.manifest.blocks)
    return Task(executor, Actions(spec), prepared, budget, seed, artifact.pruner, kinds)
