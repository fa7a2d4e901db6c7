"""``ttscompile bench --control-hz``: which plans keep up with a control loop, and how late it wakes beside one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any

import numpy as np
from rich.console import Console

from ttscompile.cli.output import say, table
from ttscompile.core.plan import UNIFORM
from ttscompile.errors import DeadlineMissedError
from ttscompile.measure.units import ms
from ttscompile.report.timing import Contestant, Measurement
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings, Feasibility, GuardLimits
from ttscompile.runtimes.executor.measure import Jitter, measure_jitter, some_observation
from ttscompile.runtimes.executor.settings import Resolved, resolve

JITTER_HZ = 200


@dataclass(frozen=True)
class LoopReport:
    """Which plans keep up.

    Attributes:
        judged: a verdict by label.
        jitter: how late a loop woke, alone and beside a plan; None if that was not measured.
    """

    control_hz: float
    judged: Mapping[str, Feasibility]
    jitter: Mapping[str, Jitter] | None

    @property
    def keeps_up(self) -> bool:
        """Whether some plan does."""
        return any(one.feasible for one in self.judged.values())

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        jitter = None if self.jitter is None else {name: one.to_json() for name, one in self.jitter.items()}
        plans = {label: one.to_json() for label, one in self.judged.items()}
        return {"control_hz": self.control_hz, "plans": plans, "jitter": jitter}

    def print(self, output: Console) -> None:
        """The verdicts with their arithmetic, and how late the loop woke."""
        made = table(f"control loop of {self.control_hz:g} Hz", "longest ms", "may take ms", "up to Hz", "verdict")
        for label, one in self.judged.items():
            allowed, verdict = ms(max(1e3 * one.max_latency, 0), 4), "feasible" if one.feasible else "too slow"
            made.add_row(label, ms(1e3 * one.latency, 4), allowed, f"{one.max_policy_hz:.3g}", verdict)
        output.print(made)
        say(output, *(f"{label}: {one.explain()}" for label, one in self.judged.items()))
        if any(UNIFORM in label for label in self.judged):
            say(output, f"{UNIFORM} is for comparisons: evenly spaced steps, not calibrated. Not for a robot.")
        say(output, "The longest call has to fit. Hz: of the policy, with as many control ticks an action as here.")
        if self.jitter is not None:
            made = table(f"{JITTER_HZ} Hz loop", "late, median ms", "p99 ms", "max ms", "ticks late by half", "work us")
            for name, late in self.jitter.items():
                figures = (f"{milliseconds:.3f}" for milliseconds in (late.p50, late.p99, late.max))
                made.add_row(name, *figures, f"{late.late} of {late.ticks}", f"{late.work_us:.1f}")
            output.print(made)


@dataclass(frozen=True)
class Loop:
    """A control loop that plans are judged for.

    Attributes:
        jitter: seconds for which a loop is run to see how late it wakes; None for not at all.
    """

    control_hz: float
    settings: ExecutorSettings
    jitter_seconds: float | None = None

    def require(self, entered: Sequence[Contestant]) -> None:
        """Raise ExecutorError unless the policies of all of these fit."""
        for one in entered:
            self._with(one)

    def _with(self, one: Contestant) -> Resolved:
        """The loop with this contestant."""
        assert one.policy is not None  # a network alone drives nothing
        return resolve(replace(self.settings, tiers=(one.plan,)), one.policy.info, self.control_hz)

    def judge(self, entered: Sequence[Contestant], measured: Sequence[Measurement], plans: Sequence[str]) -> LoopReport:
        """The longest call of each has to fit; a loop may run beside the fastest. Networks are left out."""
        driving = [(one, m) for one, m in zip(entered, measured, strict=True) if one.policy is not None]
        judged = {m.label: self._with(one).feasibility(max(m.times_ms) / 1e3) for one, m in driving}
        jitter = None
        if self.jitter_seconds is not None:
            wanted = [one for one, _ in driving if one.plan in plans]
            beside = min(wanted, key=lambda one: judged[one.label].latency)
            jitter = self._jitter(beside, judged[beside.label].latency, self.jitter_seconds)
        return LoopReport(self.control_hz, judged, jitter)

    def _jitter(self, beside: Contestant, latency: float, seconds: float) -> dict[str, Jitter]:
        """Run a loop of about ``JITTER_HZ``, alone and with the executor at work."""
        policy, policy_hz = beside.policy, self._with(beside).policy_hz
        hz = ceil(JITTER_HZ / policy_hz) * policy_hz
        settings = ExecutorSettings(
            policy_hz=policy_hz,
            tiers=(beside.plan,),
            refuse_infeasible=False,
            max_hold=int(seconds * hz) + 1,
            guard=GuardLimits(low=-np.inf, high=np.inf),  # nothing is driven, and the observation is not of this world
            trace_events=0,
        )
        alone = measure_jitter(hz, seconds)
        assert policy is not None
        with AsyncExecutor(policy, hz, settings, latencies={beside.plan: latency}) as executor:
            frames = resolve(settings, policy.info, hz).frames
            obs = some_observation(policy.info.observation)
            frame: dict[str, Any] = {key: obs[key][0, -1] if key in frames.history else obs[key][0] for key in obs}

            def work() -> None:
                executor.observe(frame)
                try:
                    executor.action()
                except DeadlineMissedError:
                    return  # before the first chunk

            with_calls = measure_jitter(hz, seconds, work)
        return {"alone": alone, f"beside plan {beside.plan!r}": with_calls}
