"""Consecutive calls with the rollout cache: the runner, corrections and training mean what the reference means."""

import numpy as np
import pytest
import torch

from tests.rounding import Counted, assert_equal_but_for_rounding
from tests.runtimes.recorded import everything_recorded
from ttscompile.calibration import runner as runner_module
from ttscompile.calibration.calls import Calls, Split, sample_calls, window_of
from ttscompile.calibration.pruner.straight_through import Practice, legal
from ttscompile.calibration.runner import Runner, whole_windows
from ttscompile.calibration.sparse_loop import fit_correction
from ttscompile.core.lattice import Source, legalize
from ttscompile.core.spec import FloatArray
from ttscompile.trajectories.episodes import Episode

from .tasks import WINDOW, MakeTask, in_windows


def random_plans(count: int, computed: float, seed: int = 0) -> np.ndarray:
    rest = (1 - computed) / 3
    plans = np.random.default_rng(seed).choice(4, (count, 10, 6), p=[computed, rest, rest, rest]).astype(np.int8)
    plans[:, 0] = Source.COMPUTE
    return plans


def one_by_one(runner: Runner, calls: Calls, plans: np.ndarray) -> torch.Tensor:
    """The same call by call, by the definition: each call legalised, its cache handed to the next of its window."""
    samples = []
    for begin in range(0, calls.count, calls.window):
        cache = runner.model.empty_cache(1)
        for i in range(begin, begin + calls.window):
            one = runner.select(calls, [i])
            plan, _ = legalize(plans[i], runner.model.groups, cache.written[0])
            made = runner.model.denoise(one.contexts, one.initial, one.noise, plan, cache, correction=runner.correction)
            samples.append(made.sample)
            cache = made.cache
    return torch.cat(samples)


@pytest.mark.slow
@pytest.mark.parametrize(("computed", "streams"), [(0.1, 256), (0.5, 256), (0.5, 5)])
def test_windows_equal_the_reference_call_by_call(
    make_task: MakeTask, computed: float, streams: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner_module, "STREAMS", streams)  # 5: a window at a time
    task = make_task(calls=2)
    calls, plans = in_windows(task, 3), random_plans(12, computed)
    with Counted() as counted:
        expected = one_by_one(task.runner, calls, plans)
    found = task.runner.run(plans, calls)
    assert_equal_but_for_rounding(found, expected, counted.terms)
    without = np.where(plans == Source.ROLLOUT, Source.TIMESTEP, plans).astype(np.int8)
    assert (task.runner.run(without, calls) - found).abs().max() > 1e-3  # else nothing was read


def test_windows_do_not_read_of_each_other(make_task: MakeTask) -> None:
    task = make_task(calls=2)
    calls, plans = in_windows(task, 3), random_plans(12, 0.3)
    together, alone = task.runner.run(plans, calls), np.arange(WINDOW, 2 * WINDOW)
    one = task.runner.run(plans[alone], task.runner.select(calls, alone))
    torch.testing.assert_close(one, together[alone], rtol=1e-5, atol=1e-6)


def test_a_schedule_never_reads_an_earlier_call(make_task: MakeTask) -> None:
    """What it would read, no call of the episode computes: a fixed plan has no use for ROLLOUT."""
    task = make_task(calls=2)
    calls, plan = in_windows(task, 2), random_plans(1, 0.3)[0]
    without = np.where(plan == Source.ROLLOUT, Source.TIMESTEP, plan).astype(np.int8)
    assert torch.equal(task.runner.run(plan, calls), task.runner.run(without, calls))
    assert (legal(np.stack([plan] * 8), WINDOW) != Source.ROLLOUT).all()


def test_legal_plans_are_those_that_a_runtime_would_make_of_them(make_task: MakeTask) -> None:
    task, plans = make_task(calls=2), random_plans(8, 0.2)
    written = np.zeros((2, 10, 6), np.bool_)
    expected = np.empty_like(plans)
    for place in range(WINDOW):
        expected[place::WINDOW], _ = legalize(plans[place::WINDOW], task.runner.model.groups, written)
        written |= expected[place::WINDOW] == Source.COMPUTE
    np.testing.assert_array_equal(legal(plans, WINDOW), expected)
    assert (expected == Source.ROLLOUT).any()
    assert (expected != plans).any()


def test_what_is_selected_is_windows_where_whole_ones_are_taken(make_task: MakeTask) -> None:
    task = make_task(calls=2)
    calls = in_windows(task, 3)
    for numbers, window in (([8, 9, 10, 11, 0, 1, 2, 3], 4), ([1, 2, 3, 4], 1), ([0, 1, 2], 1), ([3, 2, 1, 0], 1)):
        assert task.runner.select(calls, numbers).window == window
        assert whole_windows(np.array(numbers), 4) == (window == 4)


def test_windows_are_consecutive_and_of_one_episode() -> None:
    episodes = [Episode("made up", {"obs": np.zeros((n, 2), np.float32)}) for n in (3, 9, 4, 13)]
    split = Split(calibration=(0, 1, 3), validation=(2,))
    assert window_of(episodes, split) == 4
    chosen = sample_calls(episodes, split.calibration, 100, 0, window=4)
    assert len(chosen) == 4 * (2 + 3)
    windows = np.array(chosen).reshape(-1, 4, 2)
    assert (windows[:, :, 0] == windows[:, :1, 0]).all()
    assert (np.diff(windows[:, :, 1]) == 1).all()
    assert len(sample_calls(episodes, split.calibration, 11, 0, window=4)) == 8
    assert len(sample_calls(episodes, (2,), 100, 0, repeats=3, window=4)) == 12


@pytest.mark.slow
def test_a_correction_of_plans_that_differ_and_read_earlier_calls(make_task: MakeTask) -> None:
    """It is fitted along the plans: with it the samples are nearer to the dense ones; and the reference applies it."""
    task = make_task(calls=2)
    calls, plans = in_windows(task, 30), random_plans(120, 0.4)
    correction = fit_correction(task.runner, plans, calls, reads=False)
    corrected = task.runner.corrected(correction)
    plain, better = (float((one.run(plans, calls) - calls.targets).abs().mean()) for one in (task.runner, corrected))
    assert better < plain
    some = task.runner.select(calls, np.arange(8))
    with Counted() as counted:
        expected = one_by_one(corrected, some, plans[:8])
    assert_equal_but_for_rounding(corrected.run(plans[:8], some), expected, counted.terms)
    other = fit_correction(task.runner, random_plans(120, 0.4, seed=1), calls, reads=False)
    assert correction is not None and other is not None
    assert np.abs(correction.weights - other.weights).max() > 1e-4


def one_hot(plans: np.ndarray) -> torch.Tensor:
    return torch.nn.functional.one_hot(torch.from_numpy(plans.astype(np.int64)), 4).float().requires_grad_()


def test_training_runs_what_the_executor_runs(make_task: MakeTask) -> None:
    task = make_task(calls=2)
    calls, plans = in_windows(task, 3), legal(random_plans(12, 0.3), WINDOW)
    numbers = np.arange(4, 12)
    samples = Practice(task.runner, calls).samples(plans[numbers], one_hot(plans[numbers]), numbers)
    expected = task.runner.run(plans[numbers], task.runner.select(calls, numbers))
    torch.testing.assert_close(samples[-1].detach(), expected, rtol=1e-4, atol=1e-5)
    assert len(samples) == 10


def test_gradients_of_gates_are_those_of_the_whole_formula_where_all_is_computed(make_task: MakeTask) -> None:
    """There what a block would compute is what the dense call computed: but for the type it is kept in."""
    task = make_task(calls=2)
    calls = in_windows(task, 2, window=1)
    plans = np.zeros((2, 10, 6), np.int8)
    plans[:, 6, 2] = Source.TIMESTEP  # beside one reused cell
    weight = torch.from_numpy(np.random.default_rng(2).standard_normal(calls.targets.shape).astype(np.float32))

    def gradient(samples: torch.Tensor, gates: torch.Tensor) -> FloatArray:
        return np.asarray(torch.autograd.grad((samples * weight).sum(), gates)[0].numpy())

    ours, theirs = one_hot(plans), one_hot(plans)
    found = gradient(Practice(task.runner, calls).samples(plans, ours, np.arange(2))[-1], ours)
    whole = everything_recorded(task.runner.model, calls.contexts, calls.initial, calls.noise, theirs, {})
    expected = gradient(whole, theirs)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found[:, 1:] / scale, expected[:, 1:] / scale, atol=0.01)
