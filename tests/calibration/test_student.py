"""The training of a student alone: what it may change, what it learns, and what it is judged by."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.calibration.calls import prepare_calls
from ttscompile.calibration.distill import _train
from ttscompile.calibration.execute import Executor
from ttscompile.calibration.progress import Bar
from ttscompile.calibration.state import StateFile
from ttscompile.calibration.student import Student, trainable
from ttscompile.calibration.task import Clock
from ttscompile.trajectories.episodes import Episode

from . import policies


def _student(artifact: Artifact) -> tuple[Student, Any]:
    spec, executor = artifact.manifest.spec, Executor(artifact)
    draw = np.random.default_rng(0)
    episode = Episode("test", {"obs": draw.standard_normal((8, 2, 3)).astype(np.float32)})
    calls = prepare_calls(executor.model, spec, [episode], [(0, i) for i in range(8)], (0,))
    calls = replace(calls, path=executor.run_dense(calls))
    one = Student(artifact, artifact.schedule("schedule"), None, 4, 0, 100)
    return one, one.lesson(calls)


def test_a_change_touches_blocks_alone(compiled: Path) -> None:
    artifact = load_artifact(compiled)
    names = trainable(artifact, 4)
    assert len(names) == 3 * policies.LAYERS
    elsewhere = {name for key, graph in artifact.graphs.items() if "block" not in key for name in graph.constants}
    assert not elsewhere & set(names)


def test_training_learns_its_lesson(scheduled: Path) -> None:
    """Eight calls by heart: what it is judged on otherwise is other calls, of a network that nobody trained."""
    one, lesson = _student(load_artifact(scheduled))
    losses = [one.update(lesson, 0.0) for _ in range(80)]
    assert losses[-1] < 0.5 * losses[0]


def test_what_is_judged_is_what_is_written(scheduled: Path) -> None:
    """The whole loop of the student, step 0 with the original's weights: before training and after it."""
    artifact = load_artifact(scheduled)
    one, lesson = _student(artifact)
    plan, calls = artifact.schedule("schedule"), lesson.calls
    for updates in (0, 40):
        for _ in range(updates):
            one.update(lesson, 0.0)
        written = Executor(artifact.with_weights(one.weights())).run(plan, calls)
        torch.testing.assert_close(one.executor.run(plan, calls), written, rtol=0, atol=1e-5)
    assert not torch.allclose(written, Executor(artifact).run(plan, calls), atol=1e-2)


def test_an_update_follows_the_gradient_of_the_loss(scheduled: Path) -> None:
    """Gradients of the factors are those of the changes that they make, by finite differences of the loss."""
    artifact = load_artifact(scheduled)
    one, lesson = _student(artifact)
    for _ in range(3):
        one.update(lesson, 0.0)
    numbers = np.arange(8)
    loss, gradients = one._gradients(lesson, 8, numbers)
    name = next(iter(gradients))
    factor, direction = one._factors[name], torch.sign(gradients[name])
    width = 1e-3
    losses = []
    for sign in (1, -1):
        factor += sign * width * direction
        one._write()
        losses.append(one._gradients(lesson, 8, numbers)[0])
        factor -= sign * width * direction
    slope = (losses[0] - losses[1]) / (2 * width)
    assert slope == pytest.approx(float(gradients[name].abs().sum()), rel=0.05)
    assert loss < losses[0]


def test_the_time_limit_ends_training(scheduled: Path, tmp_path: Path) -> None:
    one, lesson = _student(load_artifact(scheduled))
    _train(one, lesson.calls, StateFile(tmp_path, {}), Clock(0.0), Bar(False), 100)
    assert one.done == 1  # the first update is not asked how long it will take
