"""Calls of a large policy on several numbers of threads, in one table, for ``large.py --threads 1,2``.

Seconds are the clock's, so let the machine be quiet; of each pass it is told how long threads waited for others to
leave the processor. Contestants take turns call by call, and numbers of threads in passes. What does not fit into
memory beside the others was timed before, in a process of its own: ``alone``.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import torch
from large_calls import PARTS, Arithmetic, Times, lowered, plans_of, timed
from large_smolvla import call
from rate import Clock
from waiting import from_now_on

from ttscompile import Plan, PolicySpec
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy

EAGER, EXACT = "eager", "fp32"
"""What ``alone`` may have timed, and how its file begins."""

Call = Callable[[], tuple[np.ndarray, list[float]]]
"""Gives actions, and the seconds of the parts of the call."""


def clock_of(threads: Sequence[int]) -> Clock:
    """Whose seconds count: the processor's on one thread, since the machine may be busy, and else the clock's."""
    return process_time if set(threads) == {1} else perf_counter


def alone(folder: Path, what: str, calls: Callable[[int], Call], threads: Sequence[int], rounds: int) -> None:
    """Write the actions of one contestant, and what its calls take: medians of all but the first.

    Args:
        folder: with the artifact.
        what: ``EAGER`` or ``EXACT``.
        calls: of so many threads.
        threads: numbers of them, one after the other.
        rounds: that are counted.
    """
    found = []
    for count in threads:
        torch.set_num_threads(count)
        own, waited = calls(count), from_now_on()
        made = [own() for _ in range(rounds + 1)]
        found.append([statistics.median(part) for part in zip(*(split for _, split in made[1:]), strict=True)])
        actions = made[0][0]
        parts = ", ".join(f"{part:.2f}" for part in found[-1])
        print(f"{sum(found[-1]):8.2f} s  {what} on {count}: {parts}; {waited()}")
        del own  # there may be no memory for two of them
    np.savez(folder / f"{what}.npz", actions=actions, seconds=found, threads=threads)


def known(folder: Path, what: str) -> Call | None:
    """What ``alone`` has written, for as many threads as torch has now; None if it has not."""
    path = folder / f"{what}.npz"
    if not path.exists():
        return None
    kept = dict(np.load(path))
    by_threads = dict(zip(kept["threads"].tolist(), kept["seconds"].tolist(), strict=True))
    return lambda: (kept["actions"], by_threads[torch.get_num_threads()])


def exact_calls(folder: Path, clock: Clock) -> Callable[[int], Call]:
    """Dense calls in fp32, before the loop and in it, for ``alone``."""
    artifact = load_artifact(folder / "compiled")
    plan = artifact.plan(f"dense@{EXACT}")
    obs, noise = call(artifact.manifest.spec)

    def calls(threads: int) -> Call:
        policy = open_policy(artifact, threads=threads, plan=plan)
        times = Times(Arithmetic(artifact), threads, clock)

        def own() -> tuple[np.ndarray, list[float]]:
            policy.forget_frames()
            return timed(policy, obs, noise, plan, times, EXACT, EXACT), times.last(f"{EXACT}: {PARTS}")

        return own

    return calls


def compare(
    folder: Path, parts: str, eager: Call, spec: PolicySpec, computed: int, threads: Sequence[int], rounds: int
) -> None:
    """Eager, dense in fp32, dense in fewer bits and with few steps: a line each and pass, and then a table.

    Args:
        folder: with the artifact.
        parts: what ``eager`` takes the time of.
        eager: a call of the original on as many threads as torch has, by the clock.
        spec: of the policy.
        computed: how many steps the sparse plan computes.
        threads: numbers of them.
        rounds: that are counted.
    """
    artifact = load_artifact(folder / "compiled")
    passes = [_one_pass(folder, artifact, parts, eager, spec, computed, count, rounds) for count in threads]
    print(f"| seconds a call | {' | '.join(_counted(count) for count in threads)} | {threads[-1]} of {threads[0]} |")
    print(f"| --- | {'--- | ' * len(threads)}--- |")
    for name in passes[0]:
        cells = [f"{sum(one[name]):.2f} ({', '.join(f'{part:.2f}' for part in one[name])})" for one in passes]
        print(f"| {name} | {' | '.join(cells)} | {sum(passes[-1][name]) / sum(passes[0][name]):.2f} |")


def _counted(count: int) -> str:
    return f"{count} thread{'s' * (count > 1)}"


def _one_pass(
    folder: Path,
    artifact: Artifact,
    parts: str,
    eager: Call,
    spec: PolicySpec,
    computed: int,
    threads: int,
    rounds: int,
) -> Mapping[str, list[float]]:
    """Medians of the seconds of all contestants' parts."""
    torch.set_num_threads(threads)
    bits, exact = lowered(artifact), known(folder, EXACT)
    plans: dict[str, tuple[str, Plan]] = {
        f"{name}, {bits}": (bits, plan) for name, plan in plans_of(artifact, bits, computed).items()
    }
    if exact is None:
        plans = {f"dense, {EXACT}": (EXACT, artifact.plan(f"dense@{EXACT}")), **plans}
    policy: CompiledPolicy = open_policy(artifact, threads=threads, plan=next(iter(plans.values()))[1])
    obs, noise = call(spec)
    times, waited = Times(Arithmetic(artifact), threads, perf_counter), from_now_on()
    print(f"On {_counted(threads)}:")
    for _ in range(rounds + 1):  # the first does not count
        times.next_round()
        eagerly = {f"eager: {parts}": eager()}
        if exact is not None:
            eagerly[f"dense, {EXACT}: {PARTS}"] = exact()
        for name, (precision, plan) in plans.items():
            policy.forget_frames()  # every call sees the same observation
            timed(policy, obs, noise, plan, times, precision, name)
            assert policy.last_report is not None
            if name.startswith("dense"):  # whose FLOPs are those of the original
                for other, (_, split) in eagerly.items():
                    times.add(other, EXACT, split, policy.last_report)
                eagerly.clear()
    times.tell(1)
    print(f"{'':10}{waited()}")
    found = times.medians(1)
    return {name: found[name] for name in sorted(found, key=lambda one: not one.startswith(EAGER))}
