"""The training of a student alone: what it may change, what it learns, and what it is judged by."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.calibration import policies
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.stores import BlockWeights
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import prepare_calls
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.kept import holding
from ttscompile.calibration.proposer import Proposal
from ttscompile.calibration.proposers.weights import NAME, Lesson, Student, Weights, trainable
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.trials import Trials
from ttscompile.core.coercion import Array
from ttscompile.core.lattice import whole_steps_plan
from ttscompile.core.plan import Plan
from ttscompile.trajectories.episodes import Episode

from .trying import request, trials_of


@pytest.fixture
def trials(artifact: Path, recording: Path) -> Trials:
    return trials_of(artifact, [recording])


PLAN = Plan(cells=whole_steps_plan(policies.STEPS, 2 * policies.LAYERS, [0, 5]), weights=NAME)


def with_weights(trials: Trials, weights: dict[str, Array]) -> Runner:
    held = holding(trials, Proposal(NAME, PLAN, weights={NAME: BlockWeights(weights, {})}))
    return Runner(view_of(held.artifact, PLAN))


def _student(trials: Trials) -> tuple[Student, Lesson]:
    artifact, runner = trials.artifact, trials.runner
    draw = np.random.default_rng(0)
    episode = Episode("test", {"obs": draw.standard_normal((8, 2, 3)).astype(np.float32)})
    calls = prepare_calls(runner.model, artifact.manifest.spec, [episode], [(0, i) for i in range(8)], (0,))
    calls = replace(calls, path=runner.run_dense(calls))
    own = with_weights(trials, {name: artifact.weights[name] for name in trainable(artifact, 4)})
    one = Student(own, PLAN, 4, 0, 100)
    return one, one.lesson(calls)


def test_a_change_touches_blocks_alone(compiled: Path) -> None:
    artifact = load_artifact(compiled)
    names = trainable(artifact, 4)
    assert len(names) == 3 * policies.LAYERS
    elsewhere = {name for key, graph in artifact.graphs.items() if "block" not in key for name in graph.constants}
    assert not elsewhere & set(names)


def test_training_learns_its_lesson(trials: Trials) -> None:
    """Eight calls by heart: what it is judged on otherwise is other calls, of a network that nobody trained."""
    one, lesson = _student(trials)
    losses = [one.update(lesson, 0.0) for _ in range(80)]
    assert losses[-1] < 0.5 * losses[0]


def test_what_is_judged_is_what_is_written(trials: Trials) -> None:
    """The whole loop of the student, step 0 with the original's weights: before training and after it."""
    assert PLAN.cells is not None
    one, lesson = _student(trials)
    for updates in (0, 40):
        for _ in range(updates):
            one.update(lesson, 0.0)
        written = with_weights(trials, one.weights()).run(PLAN.cells, lesson.calls)
        torch.testing.assert_close(one.runner.run(PLAN.cells, lesson.calls), written, rtol=0, atol=1e-5)
    assert not torch.allclose(written, trials.runner.run(PLAN.cells, lesson.calls), atol=1e-2)


def test_an_update_follows_the_gradient_of_the_loss(trials: Trials) -> None:
    """Gradients of the factors are those of the changes that they make, by finite differences of the loss."""
    one, lesson = _student(trials)
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


def test_the_time_limit_ends_training(trials: Trials) -> None:
    one, _ = _student(trials)
    Weights(request(updates=100))._train(one, trials, Clock(0.0))
    assert one.done == 1  # the first update is not asked how long it will take
