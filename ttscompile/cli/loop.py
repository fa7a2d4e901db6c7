"""``ttscompile bench --control-hz``: which plans keep up with a control loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rich.console import Console

from ttscompile.cli.output import say, table
from ttscompile.core.plan import UNIFORM
from ttscompile.measure.units import ms
from ttscompile.report.timing import Contestant, Measurement
from ttscompile.runtimes.executor import ExecutorSettings, Feasibility
from ttscompile.runtimes.executor.settings import Resolved, resolve


@dataclass(frozen=True)
class LoopReport:
    """Which plans keep up: a verdict by label."""

    control_hz: float
    judged: Mapping[str, Feasibility]

    @property
    def keeps_up(self) -> bool:
        """Whether some plan does."""
        return any(one.feasible for one in self.judged.values())

    @property
    def may_take_ms(self) -> float:
        """Milliseconds that the longest call may take, of whatever plan."""
        return 1e3 * max(min(one.max_latency for one in self.judged.values()), 0.0)

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {"control_hz": self.control_hz, "plans": {label: one.to_json() for label, one in self.judged.items()}}

    def print(self, output: Console) -> None:
        """The verdicts with their arithmetic."""
        made = table(f"control loop of {self.control_hz:g} Hz", "longest ms", "may take ms", "up to Hz", "verdict")
        for label, one in self.judged.items():
            allowed, verdict = ms(max(1e3 * one.max_latency, 0), 4), "feasible" if one.feasible else "too slow"
            made.add_row(label, ms(1e3 * one.latency, 4), allowed, f"{one.max_policy_hz:.3g}", verdict)
        output.print(made)
        say(output, *(f"{label}: {one.explain()}" for label, one in self.judged.items()))
        if any(UNIFORM in label for label in self.judged):
            say(output, f"{UNIFORM} is for comparisons: evenly spaced steps, not calibrated. Not for a robot.")
        say(output, "The longest call has to fit. Hz: of the policy, with as many control ticks an action as here.")


@dataclass(frozen=True)
class Loop:
    """A control loop that plans are judged for."""

    control_hz: float
    settings: ExecutorSettings

    def require(self, entered: Sequence[Contestant]) -> None:
        """Raise ExecutorError unless the policies of all of these fit."""
        for one in entered:
            self._with(one)

    def _with(self, one: Contestant) -> Resolved:
        assert one.policy is not None  # a network alone drives nothing
        return resolve(replace(self.settings, tiers=(one.plan,)), one.policy.info, self.control_hz)

    def judge(self, entered: Sequence[Contestant], measured: Sequence[Measurement]) -> LoopReport:
        """The longest call of each has to fit. Networks are left out."""
        driving = [(one, m) for one, m in zip(entered, measured, strict=True) if one.policy is not None]
        judged = {m.label: self._with(one).feasibility(max(m.times_ms) / 1e3) for one, m in driving}
        return LoopReport(self.control_hz, judged)
