"""``ttscompile realtime``: at which rates this machine can run which plans of an artifact in a control loop."""

from __future__ import annotations

from math import ceil
from pathlib import Path
from typing import Any

import click
import numpy as np

import ttscompile
from ttscompile.artifact.manifest import marked
from ttscompile.cli.options import (
    artifact_argument,
    json_option,
    loop_options,
    runs_option,
    runtime_options,
    threads_option,
)
from ttscompile.cli.output import print_identity, print_json, progress, results, say, table
from ttscompile.cli.types import RATE, SECONDS, TEXT
from ttscompile.core.plan import UNIFORM
from ttscompile.errors import DeadlineMissedError
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.measure.timer import Times
from ttscompile.measure.units import ms
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings, Feasibility, GuardLimits, MonotonicClock
from ttscompile.runtimes.executor.measure import Jitter, measure_jitter, measure_latencies, some_observation
from ttscompile.runtimes.executor.settings import resolve
from ttscompile.runtimes.policy import CompiledPolicy

JITTER_HZ = 200


@click.command()
@artifact_argument
@click.option("--control-hz", type=RATE, required=True, help="Rate of the control loop in Hz.")
@threads_option("Threads that the policy computes with.")
@loop_options
@runtime_options
@click.option(
    "--plan",
    "names",
    type=TEXT,
    multiple=True,
    help="A plan to measure; may be repeated. Without this option all plans are measured.",
)
@runs_option("Calls of each plan that are counted.")
@click.option(
    "--jitter",
    "jitter_seconds",
    type=SECONDS,
    help=f"Also run a loop of {JITTER_HZ} Hz for this many seconds, first alone and then beside the default plan, and"
    " say how late it wakes.",
)
@json_option
@click.pass_context
def realtime(
    context: click.Context,
    /,
    directory: Path,
    control_hz: float,
    names: tuple[str, ...],
    threads: int,
    runtime: str,
    device: str | None,
    runs: int,
    jitter_seconds: float | None,
    as_json: bool,
    **loop: Any,
) -> None:
    """Measure the plans of the artifact DIRECTORY and say which of them keep up with a control loop.

    The exit status is 1 if none does.
    """
    console = progress()
    policy = ttscompile.load(directory, runtime, threads, device=device)
    settings = ExecutorSettings(measured_calls=runs, tiers=names or policy.info.plans, **loop)
    resolved = resolve(settings, policy.info, control_hz)
    with console.status("timing"):
        policy.reset()
        measured = measure_latencies(policy, MonotonicClock(), settings, resolved.tiers)
    judged = {name: resolved.feasibility(max(times.ms) / 1e3) for name, times in measured.items()}
    jitter = None
    if jitter_seconds is not None:
        default = policy.info.default_plan  # which a robot runs; the fastest, where that was not measured
        beside = default if default in judged else min(judged, key=lambda name: judged[name].latency)
        with console.status("measuring jitter"):
            jitter = _jitter(policy, beside, resolved.policy_hz, judged[beside].latency, jitter_seconds)
    if as_json:
        of = {"identity": policy.info.identity, "machine": fingerprint(), "threads": threads, "runs": runs}
        plans = {name: {"median_ms": measured[name].median} | each.to_json() for name, each in judged.items()}
        loops = None if jitter is None else {name: each.to_json() for name, each in jitter.items()}
        print_json(of | {"plans": plans, "jitter": loops})
    else:
        _print(measured, judged, jitter, f"Of {runs} calls with {threads} thread{'s' * (threads > 1)}")
        print_identity(policy.info.identity, results())
    if not any(each.feasible for each in judged.values()):
        context.exit(1)


def _print(
    measured: dict[str, Times], judged: dict[str, Feasibility], jitter: dict[str, Jitter] | None, counted: str
) -> None:
    output = results()
    made = table("plan", "median ms", "longest ms", "may take ms", "up to Hz", "verdict")
    for name, each in judged.items():
        made.add_row(
            marked(name),
            ms(measured[name].median, 4),
            ms(1e3 * each.latency, 4),
            ms(max(1e3 * each.max_latency, 0), 4),
            f"{each.max_policy_hz:.3g}",
            "feasible" if each.feasible else "too slow",
        )
    output.print(made)
    say(output, *(f"{marked(name)}: {each.explain()}" for name, each in judged.items()))
    if UNIFORM in judged:
        say(output, f"{UNIFORM} is for comparisons: evenly spaced steps, not calibrated. Not for a robot.")
    say(output, f"{counted}; the longest has to fit. Hz: of the policy, with as many control ticks an action as here.")
    if jitter is not None:
        made = table(f"{JITTER_HZ} Hz loop", "late, median ms", "p99 ms", "max ms", "ticks late by half", "work us")
        for name, one in jitter.items():
            late = (f"{milliseconds:.3f}" for milliseconds in (one.p50, one.p99, one.max))
            made.add_row(name, *late, f"{one.late} of {one.ticks}", f"{one.work_us:.1f}")
        output.print(made)
    say(output, one_line(fingerprint()))


def _jitter(policy: CompiledPolicy, name: str, policy_hz: float, latency: float, seconds: float) -> dict[str, Jitter]:
    """A loop of about ``JITTER_HZ``, alone and with the executor at work."""
    hz = ceil(JITTER_HZ / policy_hz) * policy_hz
    settings = ExecutorSettings(
        policy_hz=policy_hz,
        tiers=(name,),
        refuse_infeasible=False,
        max_hold=int(seconds * hz) + 1,
        guard=GuardLimits(low=-np.inf, high=np.inf),  # nothing is driven, and the observation is not of this world
        trace_events=0,
    )
    alone = measure_jitter(hz, seconds)
    with AsyncExecutor(policy, hz, settings, latencies={name: latency}) as executor:
        frames = resolve(settings, policy.info, hz).frames
        obs = some_observation(policy.info.observation)
        frame: dict[str, Any] = {key: obs[key][0, -1] if key in frames.history else obs[key][0] for key in obs}

        def work() -> None:
            executor.observe(frame)
            try:
                executor.action()
            except DeadlineMissedError:
                return  # before the first chunk

        beside = measure_jitter(hz, seconds, work)
    return {"alone": alone, f"beside plan {name!r}": beside}
