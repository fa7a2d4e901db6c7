"""Timing of policies that take turns, call by call, on the same observations and noise."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np

from ..core.lattice import Source
from ..core.spec import Noise, PolicySpec
from ..measure.machine import fingerprint, one_line
from ..measure.timer import Timer, Times
from ..measure.units import flops, ms, share
from ..runtimes.policy import CompiledPolicy
from ..runtimes.random_calls import Observation, random_call
from .page import Section, Table

WARM_UP = 3
"""Calls of each that are not counted: allocations, and the first call of an episode, which cannot use ROLLOUT."""

PARTS = {
    "prologue": "prologue",
    "frames": "of it frames",
    "pruner": "pruner",
    "wait_pruner": "wait for it",
    "decode": "loop",
}
"""Of a call's report, and what they are called. The pruner runs beside step 0: only the wait for it counts."""


@dataclass(frozen=True)
class Contestant:
    """One way to make a call.

    Attributes:
        label: name of the contestant, for people.
        call: one call, given an observation of one stream and noise.
        report: the report of the last call; None if there is none, and everything was computed.
        dense_flops: of a call without a report; None where they are not known.
        policy: that runs the plan; None of a network.
    """

    label: str
    plan: str
    call: Callable[[Observation, Noise], object]
    report: Callable[[], Any]
    spec: PolicySpec
    dense_flops: float | None
    policy: CompiledPolicy | None = None
    threads: int = 1


@dataclass(frozen=True)
class Measurement:
    """What the counted calls of one contestant took.

    Attributes:
        parts_ms: median of each of ``PARTS``; empty without reports.
        flops: median over the calls; None where they are not known.
        sparsity: mean share of reused cells.
        legalised: cells that had to be replaced because they were never computed, all calls together.
        otherwise: of a plan that begins with the chunk of the call before, as all counted calls did, the plan of a call
            that has none.
    """

    label: str
    plan: str
    times_ms: tuple[float, ...]
    parts_ms: Mapping[str, float] = field(default_factory=dict)
    flops: float | None = None
    sparsity: float = 0.0
    legalised: int = 0
    otherwise: str | None = None

    @property
    def median_ms(self) -> float:
        """Median of the times."""
        return Times(self.times_ms).median

    @property
    def quartiles_ms(self) -> tuple[float, float]:
        """First and third quartile of the times."""
        return Times(self.times_ms).quartiles

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return asdict(self) | {"median_ms": self.median_ms, "quartiles_ms": self.quartiles_ms}


def measure(
    entered: Sequence[Contestant],
    calls: int,
    seed: int,
    on_round: Callable[[int, int], None] = lambda done, total: None,
    warm_up: int = WARM_UP,
    in_a_row: int = 1,
) -> list[Measurement]:
    """Time the contestants in turn, so that whatever else the machine does hits all of them.

    What the others do in between takes the processor's caches, as a robot's other work does. Of several calls in a row
    the last one finds in them the weights that the one before it read.

    Args:
        entered: at least one; those of one specification get the same observations and noise.
        in_a_row: calls that each makes in its turn, of which the last is timed.
    """
    timer = Timer(len(entered), warm_up)
    reports: list[list[Any]] = [[] for _ in entered]
    specs = {id(one.spec): one.spec for one in entered}
    for number in range(warm_up + calls):
        # Each call has frames of its own: those that are known would cost a compiled policy nothing.
        numbers = range(number * in_a_row, (number + 1) * in_a_row)
        drawn = {name: [random_call(spec, each, seed) for each in numbers] for name, spec in specs.items()}
        for i in timer.round():
            one = entered[i]
            *before, last = (partial(one.call, *each) for each in drawn[id(one.spec)])
            for call in before:
                call()
            timer.time(i, last)
            if timer.counted:
                reports[i].append(one.report())
        on_round(number + 1, warm_up + calls)
    return [_summary(*one) for one in zip(entered, timer.times, reports, strict=True)]


def plan_contestant(label: str, policy: CompiledPolicy, plan: str, spec: PolicySpec) -> Contestant:
    """A plan of a loaded policy, which contestants may share if their plans read nothing of earlier calls."""

    def call(obs: Observation, noise: Noise) -> object:
        policy.forget_frames()  # of the same observation, which another contestant has seen
        return policy.predict_action(obs, noise=noise, plan=plan)

    return Contestant(label, plan, call, lambda: policy.last_report, spec, 0.0, policy)


def measure_plans(policy: CompiledPolicy, spec: PolicySpec, plans: Sequence[str], calls: int) -> list[Measurement]:
    """Time plans of one policy, which is reset before and after."""
    policy.reset()
    found = measure([plan_contestant(plan, policy, plan, spec) for plan in plans], calls, seed=0)
    policy.reset()
    return found


def timing_table(measured: Sequence[Measurement], default: str, parts: Sequence[str] = tuple(PARTS)) -> Table:
    """A row for each, with those parts of a call that take any time. ``timing_remarks`` says what the columns are."""
    parts = [part for part in parts if _taken(measured, part)]
    rows = tuple(
        (
            m.label + " (default)" * (m.plan == default and bool(m.parts_ms)),
            ms(m.median_ms, 4),
            "..".join(map(ms, m.quartiles_ms)),
            "" if m is measured[0] else f"{measured[0].median_ms / m.median_ms:.1f} x",
            "" if m.flops is None else flops(m.flops),
            share(m.sparsity),
            *("" if part not in m.parts_ms else f"{m.parts_ms[part]:.2f}" for part in parts),
        )
        for m in measured
    )
    return Table(("", "ms a call", "quartiles", "speed-up", "FLOPs", "reused", *(PARTS[part] for part in parts)), rows)


def timing_remarks(measured: Sequence[Measurement]) -> str:
    """What the table is of."""
    calls = max((len(m.times_ms) for m in measured), default=0)
    told = [
        f"Medians of {calls} calls, one stream; the contestants take turns.",
        "Speed-up: how many times faster than the first row.",
        "Right of 'reused': the ms of a call's parts.",
    ]
    for one in (each for each in measured if each.otherwise is not None):
        without = f"the first call of an episode, and a late one, compute {one.otherwise!r}"
        told.append(f"{one.plan!r} was timed with the chunk of the call before; {without}.")
    if _taken(measured, "pruner"):
        told.append("The pruner runs beside step 0: only the wait for it lengthens a call.")
    if _taken(measured, "frames"):
        told.append(
            "Every call has frames of its own, all tokens of which are computed; frames that are known, or prepared"
            " before, and tokens that a plan reuses would cost nothing."
        )
    return " ".join(told)


def latency(measured: Sequence[Measurement], default: str) -> Section:
    """What calls of a policy with one thread take on this machine."""
    on = f"1 thread; {one_line(fingerprint())}"
    return Section("Latency", (timing_remarks(measured), on), (timing_table(measured, default),))


def _taken(measured: Sequence[Measurement], part: str) -> bool:
    return any(one.parts_ms.get(part, 0) > 0 for one in measured)


def _summary(contestant: Contestant, times: Times, reports: Sequence[Any]) -> Measurement:
    if reports[0] is None:
        return Measurement(contestant.label, contestant.plan, times.ms, flops=contestant.dense_flops)
    plans = {} if contestant.policy is None else contestant.policy.plans
    plan = plans.get(contestant.plan.partition("@")[0])
    return Measurement(
        label=contestant.label,
        plan=contestant.plan,
        times_ms=times.ms,
        parts_ms={part: float(np.median([getattr(r.timings, part) for r in reports])) for part in PARTS},
        flops=float(np.median([r.flops[0] for r in reports])),
        sparsity=float(np.mean([np.mean(r.plan != Source.COMPUTE) for r in reports])),
        legalised=sum(sum(r.legalised) for r in reports),
        otherwise=next((name for name, one in plans.items() if plan and one is plan.otherwise), None),
    )
