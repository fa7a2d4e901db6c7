"""Schedules that begin alike go the same way once, and end where they would alone."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ttscompile.calibration import step_counts, whole_steps
from ttscompile.calibration.sparse_loop import SparseLoop
from ttscompile.calibration.step_counts import MOST_PLACEMENTS, other_placements, spacings
from ttscompile.calibration.task import Task
from ttscompile.calibration.whole_steps import ScheduleRuns
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import PlanArray
from ttscompile.runtimes.reference.model import ReferenceModel
from ttscompile.runtimes.reference.sampler import TorchSampler

from .tasks import MakeTask

SCHEDULES = ((0, 2, 5), (0, 2, 7), (0, 4, 5), (0, 2, 7), (0, 2), (0,), (0, 4, 5, 6))

Counted = Callable[[ScheduleRuns, Sequence[tuple[int, ...]]], tuple[list[torch.Tensor], int]]


@pytest.fixture
def task(make_task: MakeTask) -> Task:
    return make_task(calls=40, episodes=range(4))


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counted:
    """What schedules end with, and how often the network's first block was evaluated for one lane."""
    block, evaluated = ReferenceModel.block, list[int]()

    def counting(self: ReferenceModel, b: int, k: int, *given: Any) -> torch.Tensor:
        if b == 0:
            evaluated.append(k)
        return block(self, b, k, *given)

    monkeypatch.setattr(ReferenceModel, "block", counting)

    def count(made: ScheduleRuns, schedules: Sequence[tuple[int, ...]]) -> tuple[list[torch.Tensor], int]:
        evaluated.clear()
        return [made.end(steps).samples for steps in schedules], len(evaluated)

    return count


def runs_of(task: Task, reads: bool | None, bytes_: int = whole_steps.BYTES) -> ScheduleRuns:
    fitted = None if reads is None else task.runner.select(task.calls, range(30))
    judged, model = task.runner.select(task.calls, range(30, 40)), task.runner.model
    loop = SparseLoop(task.runner, fitted, judged, reads=bool(reads), whole=True)
    return ScheduleRuns(loop, model.steps, model.blocks, bytes_)


def without_jumps(task: Task, plan: PlanArray, reads: bool) -> Correction | None:
    """The correction of a plan as searches fit it."""
    loop = SparseLoop(task.runner, task.runner.select(task.calls, range(30)), None, reads=reads, whole=True)
    return loop.correction(loop.end(plan))


@pytest.mark.slow
@pytest.mark.parametrize("reads", [True, False, None])
def test_calls_beside_end_where_the_fitted_correction_leads_them(task: Task, reads: bool | None) -> None:
    judged, made = task.runner.select(task.calls, range(30, 40)), runs_of(task, reads)
    for steps in SCHEDULES:
        plan, runner = task.whole.plan(steps), task.runner
        if reads is not None:
            runner = runner.corrected(without_jumps(task, plan, reads))
        torch.testing.assert_close(made.end(steps).samples, runner.run(plan, judged), rtol=1e-4, atol=1e-4)


def test_what_is_judged_is_bounded_as_a_call_is(task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    """A correction can leave what the sampler has clipped; a call clips that once more."""
    model, table = task.runner.model, task.runner.view.manifest.spec.sampler
    last = np.arange(table.steps) == table.steps - 1
    rows: dict[str, Any] = {n: np.where(last, float(n == "x0_to_next"), getattr(table, n)) for n in table.COLUMNS[2:]}
    monkeypatch.setattr(model, "sampler", TorchSampler(replace(table, clip=0.05, **rows)))
    judged, plan = task.runner.select(task.calls, range(30, 40)), task.whole.plan((0, 2, 5))
    correction = without_jumps(task, plan, reads=True)
    found = runs_of(task, reads=True).end((0, 2, 5)).samples
    assert found.abs().max() == torch.tensor(0.05)
    torch.testing.assert_close(found, task.runner.corrected(correction).run(plan, judged), rtol=1e-4, atol=1e-4)


def test_what_schedules_share_is_computed_once(task: Task, counted: Counted) -> None:
    made = runs_of(task, reads=True)
    _, first = counted(made, [(0, 2, 5)])
    lanes = first // 3
    assert lanes == 2  # those that are fitted on, and the others
    assert counted(made, [(0, 2, 7)])[1] == lanes
    assert counted(made, [(0, 4, 5)])[1] == 2 * lanes
    assert counted(made, [(0, 4, 7), (0, 4)])[1] == 2 * lanes
    assert counted(made, [(0, 2, 7, 8)])[1] == 2 * lanes  # a schedule's last step is not kept


def test_the_same_bits_whatever_was_kept(task: Task, counted: Counted) -> None:
    kept, none = (counted(runs_of(task, True, bytes_), SCHEDULES) for bytes_ in (whole_steps.BYTES, 0))
    alone = [runs_of(task, True).end(steps).samples for steps in SCHEDULES]
    for one, two, three in zip(kept[0], none[0], alone, strict=True):
        assert one.numpy().tobytes() == two.numpy().tobytes() == three.numpy().tobytes()
    assert none[1] == 2 * sum(map(len, SCHEDULES)) > kept[1]


def test_what_was_not_of_use_for_longest_is_forgotten_first(task: Task, counted: Counted) -> None:
    made = runs_of(task, reads=None)
    made.end((0, 2, 5))
    made.end((0, 4, 5))
    held = sum({id(one): one.nbytes for places in made._kept.values() for p in places for one in p.held}.values())
    small = runs_of(task, reads=None, bytes_=held - 1)
    small.end((0, 2, 5))
    small.end((0, 4, 5))
    assert counted(small, [(0, 4, 6)])[1] == 1
    assert counted(small, [(0, 2, 6)])[1] == 2


@pytest.mark.parametrize(
    ("steps", "count", "placements"), [(16, 3, 105), (16, 2, 15), (9, 9, 1), (9, 1, 1), (16, 4, 0)]
)
def test_where_there_are_few_placements_all_are_tried(
    steps: int, count: int, placements: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(step_counts, "MOST_PLACEMENTS", MOST_PLACEMENTS)
    others = other_placements(steps, count)
    if not placements:
        assert others is None
        return
    assert others is not None
    every = [*spacings(steps, count), *others]
    assert len(every) == len(set(every)) == placements <= MOST_PLACEMENTS
    assert all(len(set(one)) == count and one[0] == 0 and list(one) == sorted(one) for one in every)
    assert np.max(every) < steps
