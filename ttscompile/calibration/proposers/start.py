"""How many steps a call needs that begins with the chunk of the call before.

Falcon (arXiv 2503.00339) begins calls so. A call of few steps may go on with that chunk whatever it observes; so the
judge also gives each plan the chunk of another episode, as if the world had changed between two calls.
"""

from dataclasses import replace

import numpy as np

from ...artifact.load import Artifact
from ...artifact.manifest import StartRecord
from ...core.lattice import PlanArray, Source, dense_plan
from ...core.plan import Plan
from ...core.start import rest_of
from ...errors import CalibrationFailedError, SpecError
from ..clock import Clock
from ..judge import further, judge
from ..kept import holding
from ..proposer import Proposal, Proposals, Proposer
from ..trials import LEARNED, Trials, base_of

NAME = "warm"
"""Of the plan."""

LAST_STEPS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89)
"""Numbers of steps that are tried, up to half of the loop: beyond that little is saved."""


class Start(Proposer):
    """Tries numbers of steps, dense and with those steps alone that the plan computes, from what costs least on."""

    margin = 1.2
    """Of what other noise changes, with the limits of a dozen episodes. On Push-T half of the loop is within it and
    loses nothing in 100 episodes, and fewer steps are beyond it and lose (``docs/decisions.md``)."""

    def applies(self, artifact: Artifact) -> str | None:
        """Whether the sampler's table tells what such a call begins with."""
        table = artifact.manifest.sampler_of(base_of(artifact).loop)
        if table.steps < 2:
            return f"a loop of {table.steps} step has no half"
        try:
            rest_of(table, 1)
        except SpecError as error:
            return str(error)
        return None

    def propose(self, trials: Trials, plan: Plan, clock: Clock) -> Proposals:
        """Plans within the margin, those of the fewest computed cells first, until one is kept."""
        whole = plan.otherwise or plan
        score, limits = judge(trials, whole, LEARNED), dict[int, float]()
        found = candidates(trials.artifact, whole)
        trials.bar.stage("numbers of steps", len(found))
        for number, one in enumerate(found):
            (steps,) = (record.steps for record in one.starts.values())
            off, limits[steps] = further(judge(holding(trials, one), one.plan, LEARNED), score)
            trials.bar.update(number + 1, f"{steps} steps: {off:.3g} further", clock.left())
            if limits[steps] <= self.margin:
                kept = yield replace(one, notes={"steps": steps, "further": off}, margin=self.margin)
                if kept:
                    self.told = f"calls but an episode's first begin with the chunk before, in the last {steps} steps"
                    return
        if min(limits.values()) > self.margin:
            least = min(limits, key=limits.__getitem__)
            told = (
                f"the last {least} steps are {limits[least]:.3g} further off at worst, and {self.margin:g} is allowed"
            )
            raise CalibrationFailedError(f"no call that begins with the chunk before is near enough: {told}.")


def candidates(artifact: Artifact, plan: Plan) -> list[Proposal]:
    """Plans of the last steps of a plan's loop, those of the fewest computed cells first."""
    steps, blocks = artifact.manifest.steps_of(plan.loop), len(artifact.manifest.blocks)
    found = dict[bytes, Proposal]()
    for last in (n for n in LAST_STEPS if n <= steps // 2):
        rests = [dense_plan(last, blocks)]
        if plan.cells is not None:
            rests.append(plan.cells[-last:].copy())
            rests[-1][0] = Source.COMPUTE
        found |= {rest.tobytes(): warm_proposal(plan, last, rest) for rest in rests}
    return sorted(found.values(), key=lambda one: np.count_nonzero(one.plan.cells == Source.COMPUTE))


def warm_proposal(plan: Plan, last: int, cells: PlanArray) -> Proposal:
    """A plan whose calls begin with the chunk before, and compute these cells of the last steps of the plan's loop."""
    loop = f"{plan.loop}-last-{last}"
    warm = replace(plan, loop=loop, cells=cells, correction=None, otherwise=plan)
    return Proposal(NAME, warm, starts={loop: StartRecord(plan.loop, last)})
