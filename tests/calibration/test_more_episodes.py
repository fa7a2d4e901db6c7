"""Whether more recorded episodes may pay: told by what half of those that there are would have given."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ttscompile.calibration import whole_steps
from ttscompile.calibration.calls import Calls
from ttscompile.calibration.task import Task
from ttscompile.calibration.whole_steps import Errors

from .tasks import MakeTask

STEPS = (0, 3)
Told = Callable[[Task, float, float], str]


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Told:
    """What is told where half of the episodes leave one error, and all of them another."""

    def tell(task: Task, half: float, every: float) -> str:
        left = {0: half, 1: every}
        seen: list[Calls] = []

        def loop(runner: object, fitted: Calls, judged: Calls, *, reads: bool, whole: bool) -> SimpleNamespace:
            assert not set(fitted.episodes) & set(judged.episodes)
            seen.append(fitted)
            number = len(seen) - 1
            return SimpleNamespace(end=lambda plan: SimpleNamespace(samples=torch.tensor(left[number])))

        monkeypatch.setattr(whole_steps, "SparseLoop", loop)
        monkeypatch.setattr(task.whole, "reads", lambda count: False)
        monkeypatch.setattr(task.whole, "_errors_of", lambda samples, of: Errors(float(samples), 0.0))
        made = task.whole.told_of_episodes(STEPS)
        if made:
            few, many = ({int(one) for one in each.episodes} for each in seen)
            assert few < many and len(few) == (len(many) + 1) // 2, "half of the episodes, against all"
            assert seen[0].count == seen[1].count, "with as many calls"
        return made

    return tell


@pytest.fixture
def task(make_task: MakeTask) -> Task:
    return make_task(calls=160, episodes=range(6))


def test_what_all_bring_over_half_is_told(task: Task, told: Told) -> None:
    assert told(task, 2.0, 1.5) == (
        "more episodes may pay: learned from 5 it is 25% nearer than learned from half of them, and 5 more to learn"
        " from may bring as much again"
    )


@pytest.mark.parametrize(("every", "gain"), [(1.96, "2%"), (2.0, "0%"), (2.5, "0%")])
def test_where_half_are_as_good_more_would_bring_nothing(task: Task, told: Told, every: float, gain: str) -> None:
    expected = f"more episodes would hardly pay: learned from 5 it is {gain} nearer than learned from half of them"
    assert told(task, 2.0, every) == expected


def test_where_nothing_is_left_nothing_is_to_gain(task: Task, told: Told) -> None:
    assert told(task, 0.0, 0.0).startswith("more episodes would hardly pay: learned from 5 it is")


def test_few_episodes_and_windows_say_nothing(make_task: MakeTask, told: Told) -> None:
    assert told(make_task(calls=160, episodes=range(4)), 2.0, 1.0) == ""


def test_it_is_measured_on_the_network_too(task: Task) -> None:
    """Fitted anew, nothing faked: the same twice, and a sentence of one of the two forms."""
    made = task.whole.told_of_episodes(STEPS)
    assert made == task.whole.told_of_episodes(STEPS)
    assert made.startswith("more episodes ") and np.char.count(made, "5") >= 1
