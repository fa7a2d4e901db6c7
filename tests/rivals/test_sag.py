"""SAG: what its head leaves out reads the last block of its kind, whatever it observes."""

from __future__ import annotations

import pytest

from tests.calibration.tasks import MakeTask, found_by
from ttscompile.calibration.pruner import paper
from ttscompile.core.lattice import Source
from ttscompile.runtimes.plans import pruner_plan


@pytest.mark.slow
def test_plans_compute_or_read_forward(make_task: MakeTask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper.Paper, "intervals", 4)
    task = make_task(24, calls=16)
    found = found_by("sag", task)
    assert found.pruner is not None
    plans = pruner_plan(task.runner.logits(task.calls, found.pruner))
    for cells in (found.schedule, plans):
        assert set(cells.reshape(-1).tolist()) == {Source.COMPUTE, Source.FORWARD}
    assert (found.schedule == Source.COMPUTE).sum() == 24
    assert found.notes["sources"]["TIMESTEP"] == found.notes["sources"]["ROLLOUT"] == 0


def test_a_head_that_may_read_more_does(make_task: MakeTask) -> None:
    """The other way round: the training that SAG's is of reads TIMESTEP at first."""
    search = paper.Paper(make_task(24, calls=8))
    search.advance(0)
    assert set(search.plan.reshape(-1).tolist()) == {Source.COMPUTE, Source.TIMESTEP}
