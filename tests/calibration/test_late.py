"""Calls with prefixes among those that a correction is fitted on: how they are drawn, answered and told of."""

from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler

import ttscompile
from tests.calibration import policies, tasks
from tests.calibration.tasks import MakeTask
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import whole_steps
from ttscompile.calibration.arguments import CallLimits
from ttscompile.calibration.calls import Calls
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.sparse_loop import fit_correction
from ttscompile.calibration.state import StateFile
from ttscompile.calibration.targets import LATE, inpaints_prefixes, late_calls
from ttscompile.calibration.task import Task
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import dense_plan
from ttscompile.runtimes.inpainting import Known, noise_levels
from ttscompile.samplers.table import sampler_table


@pytest.fixture(scope="session")
def inpainting(once: Once) -> Path:
    """The small nonlinear policy with DDIM, whose table gives the noise level of each step."""
    scheduler = DDIMScheduler(
        policies.STEPS, beta_schedule="squaredcos_cap_v2", prediction_type="v_prediction", clip_sample=False
    )
    spec = replace(policies.spec(), sampler=sampler_table(scheduler, policies.STEPS))
    module = policies.Mixer(0).eval()
    return once.compiled("mixer with ddim", lambda path: ttscompile.compile_denoiser(module, spec, path))[0]


@pytest.fixture
def make_task(inpainting: Path, recording: Path) -> MakeTask:
    return partial(tasks.make_task, inpainting, recording)


def late_of(task: Task, seed: int = 0) -> Calls:
    """The calls of a task with a prefix, answered."""
    late = late_calls(task.runner, task.calls, seed)
    return replace(late, path=task.runner.run_dense(late))


def test_a_prefix_is_what_the_policy_answered_to_the_same_observation(make_task: MakeTask) -> None:
    task = make_task(calls=120)
    late, spec = late_calls(task.runner, task.calls, 0), task.runner.view.manifest.spec
    assert late.known is not None and late.path is None
    assert late.count == 120 // LATE
    known, levels = late.known, noise_levels(spec.sampler)
    assert levels is not None
    signal, deviation = levels
    assert known.positions == slice(1, 5) and known.values.shape == (11, 40, 4, 2)
    lengths = (~np.isnan(known.values[0, :, :, 0])).sum(1)
    assert set(lengths.tolist()) == {1, 2, 3, 4}
    for n, length in enumerate(lengths.tolist()):
        answer, noise = (array[n, 1 : 1 + length].numpy() for array in (task.calls.targets, late.initial))
        np.testing.assert_array_equal(known.values[-1, n, :length], answer)
        np.testing.assert_allclose(known.values[3, n, :length], signal[3] * answer + deviation[3] * noise, atol=1e-6)
        assert np.isnan(known.values[:, n, length:]).all()
    assert not torch.equal(late.initial, task.calls.initial[:40])  # else it would answer the same again
    np.testing.assert_array_equal(late.episodes, task.calls.episodes[:40])


def test_the_dense_policy_answers_them_as_a_call_with_that_prefix(make_task: MakeTask) -> None:
    task = make_task(calls=30)
    late, model = late_of(task), task.runner.model
    assert late.known is not None and late.path is not None
    free = np.isnan(late.known.values[0, :, :, 0])
    for n in range(late.count):
        one, length = task.runner.select(late, [n]), int((~free[n]).sum())
        known = Known(slice(1, 1 + length), slice(0, 2), late.known.values[:, [n], :length])
        made = model.denoise(one.contexts, one.initial, one.noise, dense_plan(model.steps, model.blocks), known=known)
        torch.testing.assert_close(late.path[n, :, 1 + length :], torch.stack(made.samples)[:, 0, 1 + length :])


def test_some_policies_have_none(inpainting: Path, compiled: Path) -> None:
    """One that takes no prefix, and one whose prologue would have to be told of it."""
    own, other = (load_artifact(path).manifest.spec for path in (inpainting, compiled))
    assert inpaints_prefixes(own)
    assert not inpaints_prefixes(other)
    assert not inpaints_prefixes(replace(own, trained_prefix=3))


def error(task: Task, correction: Correction | None, steps: tuple[int, ...], calls: Calls) -> float:
    """Mean over the actions of a call that are not committed."""
    runner = task.runner.corrected(correction)
    wrong = (runner.run(task.whole.plan(steps), calls) - calls.targets).abs()[:, 1:5]
    if calls.known is not None:
        wrong = wrong[torch.from_numpy(np.isnan(calls.known.values[0, :, :, 0]))]
    return float(wrong.mean())


@pytest.mark.slow
def test_a_call_with_a_prefix_has_a_correction_that_was_fitted_on_such_calls(make_task: MakeTask) -> None:
    """It is nearer there, on other episodes, and calls without a prefix have the one that they had."""
    task, others = make_task(calls=900, episodes=range(4)), make_task(calls=300, episodes=range(4, 6))
    steps, late, held_out = (0, 5, 8), late_of(task), late_of(others, 1)
    plan = task.whole.plan(steps)
    before = fit_correction(task.runner, plan, task.calls, True)
    after = fit_correction(task.runner, plan, replace(task.calls, late=late), True)
    assert before is not None and after is not None and after.late is not None
    assert (before.of(3).prefixes, after.prefixes, after.of(3).prefixes) == (0, 0, 4)
    np.testing.assert_array_equal(after.weights, before.weights)
    assert error(task, after.late, steps, held_out) < 0.9 * error(task, before, steps, held_out)
    assert error(task, after.late, steps, others.calls) > error(task, before, steps, others.calls)


def test_what_a_calibration_learns_from_has_them(inpainting: Path, recording: Path, tmp_path: Path) -> None:
    limits = CallLimits(30, 120, 120)
    trials = tasks.trials_of(inpainting, recording, tmp_path, limits=limits)
    calls = trials.calls
    assert calls.late is not None and calls.late.path is not None
    assert (calls.count, calls.late.count) == (120, 120 // LATE)
    assert trials.calls is calls
    assert trials.windows.late is None
    state = StateFile(tmp_path, {})  # as after an interruption
    assert state.load()
    again = replace(trials, state=state, _calls={}).calls.late
    assert again is not None and again.path is not None
    torch.testing.assert_close(again.path, calls.late.path, rtol=0, atol=0)


@pytest.mark.parametrize(("limits", "seconds"), [((41, 122, 122), inf), ((8, 120, 120), 1e-9)])
def test_too_few_for_a_correction_are_none(
    inpainting: Path, recording: Path, tmp_path: Path, limits: tuple[int, int, int], seconds: float
) -> None:
    """Because there are few calls in all, or because the time is up."""
    clock, own = Clock(seconds), CallLimits(*limits)
    trials = tasks.trials_of(inpainting, recording, tmp_path, clock=clock, limits=own)
    assert trials.calls.count >= limits[0]
    assert trials.calls.late is None


def test_schedules_are_compared_without_them(make_task: MakeTask) -> None:
    task = make_task(calls=60)
    calls = replace(task.calls, late=late_of(task))
    errors = [whole_steps.WholeSteps(task.runner, one, 0).errors((0, 6)) for one in (task.calls, calls)]
    assert errors[0] == errors[1]
