"""Drafted steps: that checks change no distribution, and what drafters are worth that are perfect, or trained."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from math import erf, sqrt
from pathlib import Path

import drafted
import drafter
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from draft_lengths import Ahead, Place, after_the_last, by_step, fixed, that_will_be_taken
from falcon import ManySteps, output_of

from tests.calibration.tasks import make_task
from ttscompile.calibration.calls import Calls
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
    done = called(task, lambda x, k, _, one: output_of(task.runner.model, x, k, one.contexts), fixed(ahead))[1]
    assert done.drafts == done.taken == 8  # neither the first step, which is no draft, nor the last, without noise
    assert (done.rounds, done.rows) == (1 + -(-9 // ahead), 10)


def test_a_hopeless_drafter_costs_evaluations_and_no_step(task: Task) -> None:
    done = called(task, hopeless, fixed(3))[1]
    assert done.taken < done.drafts
    assert done.rounds <= 10 < done.rows


def test_who_knows_what_will_be_taken_checks_nothing_in_vain(task: Task) -> None:
    """The same sample, of the same rounds, as with as many steps as can be; and each row of an evaluation is a step."""

    def rough(x: torch.Tensor, k: int, _: torch.Tensor, one: Calls) -> torch.Tensor:
        return output_of(task.runner.model, x, k, one.contexts) + 0.5 * (k % 3 == 1)

    (sample, most), (same, known) = (called(task, rough, ahead) for ahead in (fixed(9), that_will_be_taken(9)))
    torch.testing.assert_close(same, sample)
    assert known.rows == 10 < most.rows and known.rounds == most.rounds < 10
    assert called(task, hopeless, that_will_be_taken(9))[1].rows == 10


def test_the_last_round_and_the_step_say_how_many() -> None:
    place = Place(5, 0, 0, lambda count: count)
    said = after_the_last(8)
    told = [said(replace(place, asked=asked, gone=gone)) for asked, gone in ((0, 0), (4, 4), (8, 8), (8, 2), (2, 1))]
    assert told == [4, 8, 8, 3, 2]
    # At step 3 all eight are taken, at step 7 one; an evaluation of eight takes twice as long as one of one.
    ahead = by_step({3: [8, 8, 8], 7: [1, 1, 1]}, {1: 1.0, 8: 2.0})
    assert [ahead(replace(place, step=step)) for step in (1, 3, 4, 6, 9)] == [8, 8, 8, 1, 1]


def called(
    task: Task, draft: Callable[[torch.Tensor, int, torch.Tensor, Calls], torch.Tensor], ahead: Ahead
) -> tuple[torch.Tensor, drafted.Done]:
    """One call."""
    runner, done = task.runner, drafted.Done()
    one = runner.select(task.calls, [0])
    loop, drawn = drafted.Speculating(runner, ManySteps(runner.view)), drafted.Drawn.of(10, one.initial, 0)
    with torch.no_grad():
        sample = loop.call(one.contexts, one.initial, lambda x, k, last: draft(x, k, last, one), ahead, drawn, done)
    return sample, done


def hopeless(sample: torch.Tensor, k: int, last: torch.Tensor, one: Calls) -> torch.Tensor:
    return torch.full_like(sample, 1e3 * (-1) ** k)


def test_a_drafter_learns_what_the_network_says(task: Task) -> None:
    samples, found = drafter.predictions(task.runner, task.calls)
    assert samples.shape == found.shape == (10, task.calls.count, 8, 2)
    features = task.runner.model.condition(task.calls.contexts)
    wrong = []
    for updates in (0, 60):
        learned = drafter.trained(task.runner, task.calls, 2, updates, 0)
        with torch.no_grad():
            said = learned(samples[5], torch.full((task.calls.count,), 5), found[3], features)
        wrong.append(float((said - found[5]).square().mean()))
    assert wrong[1] < 0.7 * wrong[0]


@pytest.mark.slow
def test_it_tells_of_each_drafter(compiled: Path, recording: Path, four_steps: Path) -> None:
    words = ["-t", str(recording), "--drafts", "2,3", "--calls", "2", "--learned", "8", "--updates", "5"]
    told = CliRunner().invoke(drafted.main, [str(compiled), *words, "--json"], catch_exceptions=False)
    assert told.exit_code == 0, told.output
    document = json.loads(told.stdout)
    assert document["calls"] == 2
    said = [f"as {what}" for what in ("the last round says", "the step says", "will be taken")]
    assert [row["ahead"] for row in document["rows"]] == ["1", "2", "3", "2", "3", *said]
    plain, *others = document["rows"]
    assert plain["rounds"] == plain["rows"] == 10
    assert others[-1]["rows"] == 10
    assert all(row["rounds"] <= 10 <= row["rows"] and 0 <= row["taken"] <= 1 for row in others)
    assert CliRunner().invoke(drafted.main, [str(compiled), *words]).exit_code == 0
    assert CliRunner().invoke(drafted.main, [str(compiled), "-t", str(recording), "--drafts", "1"]).exit_code == 2
    with pytest.raises(CalibrationError, match="--sampler ddpm"):
        CliRunner().invoke(drafted.main, [str(four_steps), *words], catch_exceptions=False)
