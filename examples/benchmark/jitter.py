"""How late a control loop of 200 Hz wakes on this machine, alone and beside a policy at work.

    python examples/benchmark/jitter.py compiled/ --policy-hz 50 --seconds 10

The clock that matters is the robot's: run it there, with what else runs there.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from math import ceil
from pathlib import Path
from typing import Any

import click
import numpy as np

from ttscompile.cli.options import artifact_argument, number_option, threads_option
from ttscompile.cli.output import print_json, results_console, run, table
from ttscompile.cli.types import RATE, SECONDS, TEXT
from ttscompile.errors import DeadlineMissedError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings, GuardLimits
from ttscompile.runtimes.executor.measure import some_observation
from ttscompile.runtimes.executor.settings import resolve
from ttscompile.runtimes.load import load
from ttscompile.runtimes.policy import CompiledPolicy

JITTER_HZ = 200


@dataclass(frozen=True)
class Jitter:
    """How late the ticks of a loop were, in milliseconds, and what the loop's own work took.

    Attributes:
        late: ticks that were later than half a period.
        work_us: median of the work of a tick, microseconds.
    """

    hz: float
    ticks: int
    p50: float
    p99: float
    max: float
    late: int
    work_us: float

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return asdict(self)


def measure_jitter(hz: float, seconds: float, work: Callable[[], object] = lambda: None) -> Jitter:
    """Run a loop in real time, sleeping between ticks, and measure how late it wakes.

    Args:
        hz: rate of the loop.
        seconds: how long it runs.
        work: called in every tick.
    """
    ticks = max(int(seconds * hz), 1)
    late, took = np.empty(ticks), np.empty(ticks)
    start = time.perf_counter()
    for i in range(ticks):
        due = start + (i + 1) / hz
        time.sleep(max(due - time.perf_counter(), 0.0))
        woke = time.perf_counter()
        work()
        late[i], took[i] = woke - due, time.perf_counter() - woke
    p50, p99 = (float(p) for p in np.percentile(1e3 * late, [50, 99]))
    return Jitter(
        hz=hz,
        ticks=ticks,
        p50=p50,
        p99=p99,
        max=float(1e3 * late.max()),
        late=int(np.count_nonzero(late > 0.5 / hz)),
        work_us=float(1e6 * np.median(took)),
    )


def jitter(policy: CompiledPolicy, policy_hz: float, seconds: float) -> dict[str, Jitter]:
    """Run a loop of about ``JITTER_HZ``, alone and with the executor at work."""
    plan = policy.info.default_plan
    hz = ceil(JITTER_HZ / policy_hz) * policy_hz
    settings = ExecutorSettings(
        policy_hz=policy_hz,
        tiers=(plan,),
        refuse_infeasible=False,
        max_hold=int(seconds * hz) + 1,
        guard=GuardLimits(low=-np.inf, high=np.inf),  # nothing is driven, and the observation is not of this world
        trace_events=0,
    )
    alone = measure_jitter(hz, seconds)
    with AsyncExecutor(policy, hz, settings) as executor:
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
    return {"alone": alone, f"beside plan {plan!r}": with_calls}


@click.command()
@artifact_argument
@number_option("--policy-hz", RATE, "Rate in Hz of the frames and actions of the policy.", required=True)
@number_option("--seconds", SECONDS, "Run each loop for so many seconds.", default=10.0)
@click.option("--plan", type=TEXT, help="Run this plan. Without this option it is the default plan.")
@threads_option("Threads that the policy computes with.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
def main(directory: Path, policy_hz: float, seconds: float, plan: str | None, threads: int, as_json: bool) -> None:
    """Measure how late a loop wakes, alone and beside a plan of the artifact DIRECTORY."""
    found = jitter(load(directory, threads=threads, plan=plan, seed=0), policy_hz, seconds)
    if as_json:
        print_json({name: one.to_json() for name, one in found.items()})
        return
    made = table(f"{JITTER_HZ} Hz loop", "late, median ms", "p99 ms", "max ms", "ticks late by half", "work us")
    for name, late in found.items():
        figures = (f"{milliseconds:.3f}" for milliseconds in (late.p50, late.p99, late.max))
        made.add_row(name, *figures, f"{late.late} of {late.ticks}", f"{late.work_us:.1f}")
    results_console().print(made)


if __name__ == "__main__":
    run(main)
