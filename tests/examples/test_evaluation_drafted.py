"""Drafted steps: that checks change no distribution, and what drafters are worth that are perfect, or trained."""

from __future__ import annotations

import json
from math import erf, sqrt
from pathlib import Path

import drafted
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from falcon import ManySteps, output_of

from tests.calibration.tasks import make_task
from ttscompile.calibration.task import Task
from ttscompile.errors import CalibrationError


@pytest.fixture(scope="module")
def task(compiled: Path, recording: Path) -> Task:
    """Ten steps, of which all but the last draw noise."""
    return make_task(compiled, recording)


@pytest.mark.parametrize("apart", [0.0, 0.7, 3.0])
def test_a_checked_draft_is_distributed_as_the_network_has_it(apart: float) -> None:
    draw, uniform, count = torch.Generator().manual_seed(0), np.random.default_rng(0), 4000
    wanted, deviation = torch.tensor([1.0, -2.0]), 0.5
    away = wanted + deviation * apart * torch.tensor([0.6, 0.8])
    found, taken = list[torch.Tensor](), 0
    for chance in uniform.random(count).tolist():
        sample, kept = drafted.settled(wanted, away, torch.randn(2, generator=draw), deviation, chance)
        found.append(sample)
        taken += kept
    samples = torch.stack(found)
    error = deviation / sqrt(count)
    torch.testing.assert_close(samples.mean(0), wanted, rtol=0, atol=5 * error)
    torch.testing.assert_close(torch.cov(samples.T), deviation**2 * torch.eye(2), rtol=0, atol=5 * error)
    shared = 1 - erf(apart / 2 / sqrt(2))  # of two normal distributions so far apart
    assert taken / count == pytest.approx(shared, abs=5 * sqrt(0.25 / count))


def test_a_step_without_noise_is_the_networks() -> None:
    wanted, other, noise = torch.zeros(2), torch.ones(2), torch.ones(2)
    assert drafted.settled(wanted, other, noise, 0.0, 0.5) == (wanted, False)


@pytest.mark.parametrize("ahead", [2, 4])
def test_a_perfect_drafter_needs_as_many_evaluations_as_there_are_groups_of_steps(task: Task, ahead: int) -> None:
    runner, done = task.runner, drafted.Done()
    one = runner.select(task.calls, [0])
    loop = drafted.Speculating(runner, ManySteps(runner.view), 0)
    with torch.no_grad():
        loop.call(one.contexts, one.initial, lambda x, k, _: output_of(runner.model, x, k, one.contexts), ahead, done)
    assert done.drafts == done.taken == 8  # neither the first step, which is no draft, nor the last, without noise
    assert (done.rounds, done.rows) == (1 + -(-9 // ahead), 10)


def test_a_hopeless_drafter_costs_evaluations_and_no_step(task: Task) -> None:
    runner, done = task.runner, drafted.Done()
    one = runner.select(task.calls, [0])
    loop = drafted.Speculating(runner, ManySteps(runner.view), 0)
    with torch.no_grad():
        loop.call(one.contexts, one.initial, lambda sample, k, _: torch.full_like(sample, 1e3 * (-1) ** k), 3, done)
    assert done.taken < done.drafts
    assert done.rounds <= 10 < done.rows


def test_a_drafter_learns_what_the_network_says(task: Task) -> None:
    samples, found = drafted.predictions(task.runner, task.calls)
    assert samples.shape == found.shape == (10, task.calls.count, 8, 2)
    features = task.runner.model.condition(task.calls.contexts)
    wrong = []
    for updates in (0, 60):
        drafter = drafted.trained(task.runner, task.calls, 2, updates, 0)
        with torch.no_grad():
            said = drafter(samples[5], torch.full((task.calls.count,), 5), found[3], features)
        wrong.append(float((said - found[5]).square().mean()))
    assert wrong[1] < 0.7 * wrong[0]


@pytest.mark.slow
def test_it_tells_of_each_drafter(compiled: Path, recording: Path, four_steps: Path) -> None:
    words = ["-t", str(recording), "--drafts", "2,3", "--calls", "2", "--learned", "8", "--updates", "5"]
    told = CliRunner().invoke(drafted.main, [str(compiled), *words, "--json"], catch_exceptions=False)
    assert told.exit_code == 0, told.output
    document = json.loads(told.stdout)
    assert document["calls"] == 2
    assert [row["ahead"] for row in document["rows"]] == [1, 2, 3, 2, 3]
    plain, *others = document["rows"]
    assert plain["rounds"] == plain["rows"] == 10
    assert all(row["rounds"] <= 10 <= row["rows"] and 0 <= row["taken"] <= 1 for row in others)
    assert CliRunner().invoke(drafted.main, [str(compiled), *words]).exit_code == 0
    assert CliRunner().invoke(drafted.main, [str(compiled), "-t", str(recording), "--drafts", "1"]).exit_code == 2
    with pytest.raises(CalibrationError, match="--sampler ddpm"):
        CliRunner().invoke(drafted.main, [str(four_steps), *words], catch_exceptions=False)
