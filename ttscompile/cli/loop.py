"""``ttscompile bench --control-hz``: which plans keep up with a control loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from rich.console import Console

from ttscompile.cli.output import say, table
from ttscompile.core.plan import UNIFORM
from ttscompile.measure.units import ms
from ttscompile.report.timing import Contestant
from ttscompile.runtimes.executor import ExecutorSettings, Feasibility
from ttscompile.runtimes.executor.settings import Resolved, resolve


def in_loop(entered: Sequence[Contestant], control_hz: float, settings: ExecutorSettings) -> dict[str, Resolved]:
    """The plans in a control loop, by label; a network alone drives nothing. Raises ExecutorError: one does not fit."""
    return {
        one.label: resolve(replace(settings, tiers=(one.plan,)), one.policy.info, control_hz)
        for one in entered
        if one.policy is not None
    }


def print_verdicts(verdicts: Mapping[str, Feasibility], control_hz: float | None, output: Console) -> None:
    """Whether plans keep up, by label, with the arithmetic; nothing if that was not asked."""
    if control_hz is None:
        return
    made = table(f"control loop of {control_hz:g} Hz", "longest ms", "may take ms", "up to Hz", "verdict")
    for label, one in verdicts.items():
        allowed, verdict = ms(max(1e3 * one.max_latency, 0), 4), "feasible" if one.feasible else "too slow"
        made.add_row(label, ms(1e3 * one.latency, 4), allowed, f"{one.max_policy_hz:.3g}", verdict)
    output.print(made)
    say(output, *(f"{label}: {one.explain()}" for label, one in verdicts.items()))
    if any(UNIFORM in label for label in verdicts):
        say(output, f"{UNIFORM} is for comparisons: evenly spaced steps, not calibrated. Not for a robot.")
    say(output, "The longest call has to fit. Hz: of the policy, with as many control ticks an action as here.")
