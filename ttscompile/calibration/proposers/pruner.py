"""The proposer of plans that depend on the observation: the plan head, trained as its paper trains it."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...artifact.load import Artifact
from ...artifact.view import view_of
from ...core.lattice import Source
from ...core.plan import Plan
from ...errors import CalibrationFailedError
from ...ir.pieces import PRUNER
from ...ir.plan_head import has_head
from ..clock import Clock
from ..judge import Score
from ..proposer import Proposal, Proposals, Proposer
from ..pruner.paper import Paper
from ..schedule import learned_nothing, resumed_search
from ..task import Task
from ..trials import Trials, base_of


class Pruner(Proposer):
    """Gates for each observation, on average within the cells that the plan so far computes. See ``Proposer``."""

    def applies(self, artifact: Artifact) -> str | None:
        if has_head(view_of(artifact, base_of(artifact)).pruner):
            return None
        return "the artifact has no pruner that could learn. Convert the checkpoint again."

    def propose(self, trials: Trials, plan: Plan, clock: Clock) -> Proposals:
        cells = plan.cells
        if cells is None or plan.loop != trials.base.loop:
            raise CalibrationFailedError(
                f"the pruner learns from a schedule of loop {trials.base.loop!r}; found another."
            )
        computed = int((cells == Source.COMPUTE).sum())
        task = Task.of(trials.runner, trials.windows, computed, trials.seed, trials.pool)
        search = Paper(replace(task, clock=clock))
        found, updates, _ = resumed_search(trials, search, clock, self.request.intervals, PRUNER)
        chosen = "on the calls that it was chosen on, and not trained on"
        self.told = f"{updates} updates; its best head is {found.error:.4g} off {chosen}"
        share = float(np.mean(cells != Source.COMPUTE))

        def refusal(score: Score, others: Mapping[str, Score]) -> str | None:
            if score.sparsity < share - 1e-9:
                return f"reuses {score.sparsity:.4f} of the cells on held-out calls; the schedule reuses {share:.4f}."
            return learned_nothing(score, updates)

        made = replace(plan, cells=None, correction=None)
        yield Proposal(PRUNER, made, {**found.notes, "updates": updates}, pruner=found.pruner, refusal=refusal)
