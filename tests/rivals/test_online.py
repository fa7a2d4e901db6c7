"""Criteria on recorded calls: what they decide is what their plans do, and it is within the budget on average."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.calibration.tasks import MakeTask, found_by
from tests.rounding import FLOAT64, Counted, assert_equal_but_for_rounding, bound
from ttscompile.calibration.calls import Calls
from ttscompile.core.lattice import PlanArray, Source
from ttscompile.errors import CalibrationError
from ttscompile.rivals.online import Criterion, Decisions, dbcache, decide, dense_changes, proposal, proposals, within
from ttscompile.runtimes.reference.model import ReferenceModel

from .rules import RULES


def decided_by_the_reference(model: ReferenceModel, calls: Calls, rule: Criterion) -> tuple[torch.Tensor, PlanArray]:
    """One call of each stream by the reference alone: every step is a call with the plan that is decided so far.

    Returns:
        The denoised samples ``[N, T, D]``, and the plans ``[N, K, blocks]``.
    """
    decisions = Decisions(rule, model.steps, model.blocks, calls.count)
    plan = np.full((calls.count, model.steps, model.blocks), Source.COMPUTE, np.int8)
    axis = model.stem(calls.initial, 0, calls.contexts).shape.index(calls.count)
    with torch.no_grad():
        for k in range(model.steps):
            known = model.denoise(calls.contexts, calls.initial, calls.noise, plan).samples
            stream = model.stem(known[k - 1] if k else calls.initial, k, calls.contexts)
            feature = stream if rule.always == 0 else torch.zeros_like(stream)
            for b in range(rule.always):
                residual = model.block(b, k, stream, calls.contexts)
                stream, feature = stream + residual, feature + residual
            plan[:, k] = decisions.decide(k, feature.movedim(axis, 0).numpy())
        return model.denoise(calls.contexts, calls.initial, calls.noise, plan).sample, plan


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_the_decided_plans_do_what_the_call_did(make_task: MakeTask, rule: Criterion) -> None:
    task = make_task(30)
    decided = decide(task.runner, rule, task.calls)
    with Counted() as counted:
        again = task.runner.run(decided.plans, task.calls)
    assert_equal_but_for_rounding(decided.samples, again, counted.terms)
    assert len({plan.tobytes() for plan in decided.plans}) > 1  # calls differ
    assert set(np.unique(decided.plans)) == {Source.COMPUTE, Source.TIMESTEP}
    np.testing.assert_array_equal(decided.cells, (decided.plans == Source.COMPUTE).sum((1, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_the_reference_decides_the_same(make_task: MakeTask, rule: Criterion) -> None:
    task = make_task(30)
    decided = decide(task.runner, rule, task.calls)
    model, calls = task.runner.model, task.calls
    with Counted() as counted:
        sample, plans = decided_by_the_reference(model, calls, rule)
    np.testing.assert_array_equal(plans, decided.plans)
    assert_equal_but_for_rounding(sample, decided.samples, counted.terms)
    given = model.denoise(calls.contexts, calls.initial, calls.noise, plans)
    torch.testing.assert_close(sample, given.sample, rtol=0, atol=0)
    np.testing.assert_array_equal(given.cache.written, plans == Source.COMPUTE)
    assert given.cache.residuals.keys() == {(int(k), int(b)) for _, k, b in np.argwhere(plans == Source.COMPUTE)}


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_call_does_not_depend_on_the_others(make_task: MakeTask, rule: Criterion) -> None:
    task = make_task(30)
    together = decide(task.runner, rule, task.calls)
    for i in (0, 5):
        alone = decide(task.runner, rule, task.runner.select(task.calls, [i]))
        np.testing.assert_array_equal(alone.plans[0], together.plans[i])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["teacache", "dbcache"])
@pytest.mark.parametrize("budget", [20, 40])
def test_the_threshold_uses_the_budget(make_task: MakeTask, name: str, budget: int) -> None:
    task = make_task(budget, calls=24)
    found = found_by(name, task)
    rule = Criterion.of_record(found.notes["criterion"])
    assert rule.name == name
    assert found.notes["criterion"] == rule.record()
    cells = decide(task.runner, rule, task.calls).cells
    assert found.notes["computed_cells"] == {"mean": float(cells.mean()), "most": int(cells.max())}
    assert budget - 10 < cells.mean() <= budget
    more = decide(task.runner, replace(rule, threshold=0.0), task.calls)
    assert (more.cells == 60).all()  # a threshold of nothing computes everything


@pytest.mark.parametrize("name", ["teacache", "dbcache"])
def test_the_schedule_is_the_best_decision(make_task: MakeTask, name: str) -> None:
    task = make_task(30, calls=12)
    found = found_by(name, task)
    plans = within(decide(task.runner, Criterion.of_record(found.notes["criterion"]), task.calls).plans, 30)
    errors = [task.error(plan, task.calls) for plan in plans]
    assert len(plans) > 1
    np.testing.assert_array_equal(found.schedule, plans[int(np.argmin(errors))])
    assert found.error == pytest.approx(min(errors), rel=1e-5)  # of the schedule, not of what was decided call by call


def test_decisions_within_the_budget_once_each() -> None:
    plans = np.full((5, 4, 2), Source.TIMESTEP, np.int8)
    for plan, steps in zip(plans, ([0], [0, 1], [0, 1, 2], [0, 1], [0, 3]), strict=True):
        plan[steps] = Source.COMPUTE
    found = within(plans, budget=4)
    assert [np.flatnonzero(plan[:, 0] == Source.COMPUTE).tolist() for plan in found] == [[0], [0, 1], [0, 3]]


def test_dbcache_proposes_what_the_budget_has_room_for(make_task: MakeTask) -> None:
    assert [(c.always, c.warmup) for c, _ in proposals(make_task(15))] == [(1, 1)]
    proposed = [(c.always, c.warmup) for c, _ in proposals(make_task(54))]
    assert proposed == [(1, 8), (1, 1), (2, 8), (2, 1), (3, 8), (3, 1)]


def test_dbcache_of_one_block_is_refused(make_task: MakeTask, monkeypatch: pytest.MonkeyPatch) -> None:
    task = make_task(60)
    monkeypatch.setattr(task.runner.model, "blocks", 1)
    with pytest.raises(CalibrationError, match="the policy has one block"):
        dbcache(task).advance(0)


def test_teacache_fits_its_polynomial_to_dense_calls(make_task: MakeTask) -> None:
    task = make_task(30, calls=8)
    ((criterion, start),) = proposal(task)
    before, after = dense_changes(task.runner, task.calls)
    assert len(criterion.polynomial) == 5
    left = after - np.polyval(criterion.polynomial, before)
    powers = np.vander(before, 5)
    rounding = bound(powers.size, unit=FLOAT64) * np.linalg.cond(powers) * np.abs(powers).sum(axis=0).max()
    np.testing.assert_allclose(powers.T @ left, 0, atol=rounding)  # no polynomial of degree 4 comes nearer
    assert start > 0


def test_changes_of_dense_calls(make_task: MakeTask) -> None:
    task = make_task(30)
    calls = task.runner.select(task.calls, [0, 4])
    before, after = dense_changes(task.runner, calls)
    assert before.shape == after.shape == (9 * 2,)
    model, dense = task.runner.model, np.zeros((10, 6), np.int8)
    with Counted() as counted:
        samples = model.denoise(calls.contexts, calls.initial, calls.noise, dense).samples
    stems = [model.stem(s, k, calls.contexts) for k, s in ((3, samples[2]), (4, samples[3]))]
    expected = (stems[1] - stems[0]).abs().mean((1, 2)) / stems[0].abs().mean((1, 2))
    assert_equal_but_for_rounding(before.reshape(9, 2)[3], expected, counted.terms)
    assert (after != before).all()
