"""Which parts compute in the artifact's other precision: all but those that change the actions most."""

from collections.abc import Collection
from dataclasses import replace

from ...artifact.load import Artifact
from ...core.plan import Plan
from ..clock import Clock
from ..judge import further, judge
from ..proposer import Proposal, Proposals, Proposer
from ..trials import LEARNED, Trials


class Precision(Proposer):
    """Leaves out parts, the one that changes the actions most alone first, until the rest is within the margin."""

    margin = 0.1
    """Of what other noise changes. Push-T in int8: 0.03."""

    def applies(self, artifact: Artifact) -> str | None:
        """Whether the artifact has another precision."""
        if artifact.manifest.precision is not None:
            return None
        return "the artifact has fp32 alone; make it again with --precision int8, in Python precision='int8'"

    def propose(self, trials: Trials, plan: Plan, clock: Clock) -> Proposals:
        """The plan with as many parts in the other precision as may be; with none of them in fp32, where none may."""
        record = trials.artifact.manifest.precision
        assert record is not None
        exact = judge(trials, replace(plan, precision={}), LEARNED)

        def lowered(parts: Collection[str]) -> Plan:
            return replace(plan, precision=dict.fromkeys(parts, record.name))

        def off(parts: Collection[str]) -> tuple[float, float]:
            return further(judge(trials, lowered(parts), LEARNED), exact)

        kept, left = list(record.kept), list[str]()
        trials.bar.stage("parts in another precision", len(kept))
        alone = {part: off([part])[0] for part in kept} if len(kept) > 1 else {}
        while kept and off(kept)[1] > self.margin:
            left.append(max(kept, key=lambda part: alone.get(part, 0.0)))
            kept.remove(left[-1])
            trials.bar.update(len(left), f"{left[-1]} stays fp32", clock.left())
        best = lowered(kept)
        more = f"{record.name} changes the actions more than {self.margin:g} allows"
        self.told = f"{record.name} in {' and '.join(kept)}" if kept else f"all parts stay fp32: {more}"
        if left and kept:
            self.told += f"; {' and '.join(left)} stay{'s' * (len(left) == 1)} fp32: there {more}"
        notes = {"parts": kept, "alone": alone}
        yield Proposal(trials.changed_name, best, notes, margin=self.margin, shared={"precision": best.precision})
