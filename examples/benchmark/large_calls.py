"""Calls of a large policy, timed for ``large.py``: PyTorch and compiled, and with tokens reused where an arm moves.

Seconds are the processor's where all calls are on one thread, since the machine may be busy; with several they are the
clock's. Contestants take turns, and with them a product that says what the arithmetic of their calls takes alone
(``rate.py``): the floor. ``large_threads`` has several numbers of threads in one table.
"""

from __future__ import annotations

import resource
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import process_time

import numpy as np
import torch
from large_smolvla import call
from moving import REUSE, arm, backgrounds
from rate import Clock, rates, run_all

import ttscompile
from ttscompile import Noise, Plan, PolicySpec
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.core.plan import TokenReuse
from ttscompile.ir.flops import graph_flops
from ttscompile.measure.machine import cpuinfo
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.random_calls import random_calls
from ttscompile.runtimes.report import CallReport

PARTS = "prologue, loop"
"""Of a compiled call."""

COMPARED = 3
"""Random observations that precisions are compared on: a dense call of a large policy takes seconds."""

FLOORS = {"fp32": "fp32", "int8": "int8", "int4": "int8"}
"""The product that a precision's floor is taken from: four bits are summed as eight, and bf16 is PyTorch's alone."""


class Arithmetic:
    """FLOPs of calls of an artifact, before the loop and in it."""

    def __init__(self, artifact: Artifact) -> None:
        pieces = artifact.pieces
        rows = [graph_flops(tower) for n, tower in zip(pieces.rows, pieces.towers, strict=True) for _ in range(n)]
        self._prologue = artifact.manifest.flops.prologue
        self._rows = sorted(rows, reverse=True)  # the instruction, which hardly ever is new, costs least

    def of(self, report: CallReport) -> list[float]:
        """Of one call: frames that it knew cost nothing, and tokens that it computed their share of a frame."""
        work = report.frames
        share = work.tokens / work.of if work.of else 1.0
        before = self._prologue - sum(self._rows) + share * sum(self._rows[: work.computed])
        return [before, report.flops[0] - self._prologue]


@dataclass(frozen=True)
class _Calls:
    """Of one contestant: its precision; by call the seconds of its parts; and the FLOPs before the loop and in it."""

    precision: str
    seconds: list[list[float]] = field(default_factory=list)
    flops: list[list[float]] = field(default_factory=list)


class Times:
    """What the calls of all contestants took, in turn with the products of the floor.

    Args:
        arithmetic: of the artifact.
        threads: of all calls.
        clock: by which they are timed.
    """

    def __init__(self, arithmetic: Arithmetic, threads: int = 1, clock: Clock = process_time) -> None:
        self._arithmetic, self._products = arithmetic, rates(threads, clock)
        self.clock = clock
        self._calls: dict[str, _Calls] = {}

    def add(self, name: str, precision: str, seconds: list[float], report: CallReport) -> None:
        """A call of a contestant, which computed what the report says."""
        calls = self._calls.setdefault(name, _Calls(precision))
        calls.seconds.append(seconds)
        calls.flops.append(self._arithmetic.of(report))

    def last(self, name: str) -> list[float]:
        """The seconds of a contestant's last call, by part."""
        return self._calls[name].seconds[-1]

    def medians(self, left_out: int) -> dict[str, list[float]]:
        """Of the seconds of each contestant's parts, in all calls but the first."""
        seconds = {name: calls.seconds[left_out:] for name, calls in self._calls.items()}
        return {name: [statistics.median(part) for part in zip(*own, strict=True)] for name, own in seconds.items()}

    def next_round(self) -> None:
        """Time the products of the floor."""
        run_all(self._products.values())

    def tell(self, left_out: int) -> None:
        """Print medians of all but the first calls."""
        for name, calls in self._calls.items():
            seconds, flops = calls.seconds[left_out:], calls.flops[left_out:]
            total = statistics.median(map(sum, seconds))
            parts = ", ".join(f"{statistics.median(part):.2f}" for part in zip(*seconds, strict=True))
            if calls.precision not in FLOORS:
                print(f"{total:8.2f} s  {name}, {calls.precision}: {parts}", flush=True)
                continue
            product = self._products[FLOORS[calls.precision]]
            least = [product.seconds(statistics.mean(part)) for part in zip(*flops, strict=True)]
            floor = f"floor {sum(least):.3f}: {', '.join(f'{part:.3f}' for part in least)}"
            print(f"{total:8.2f} s  {name}: {parts}; {floor}; {total / sum(least):.2f} times it", flush=True)


def compare(
    folder: Path,
    parts: str,
    eager: Callable[[], tuple[np.ndarray, list[float]]],
    spec: PolicySpec,
    computed: int,
    rounds: int = 5,
    exact: bool = True,
    threads: int = 1,
    clock: Clock = process_time,
) -> None:
    """One call after the other, in turn: eager, dense and with few computed steps, in fp32 and in fewer bits.

    Where the processor multiplies in bf16, eager is timed under autocast, too. Then it is told how far dense actions in
    fewer bits are from those in fp32, with equal noise on some random observations, and how far other noise moves
    these.

    Args:
        folder: with the artifact.
        parts: what ``eager`` takes the time of.
        eager: a call of the original.
        spec: of the policy.
        computed: how many steps the sparse plan computes.
        rounds: that are counted.
        exact: whether there is memory for calls in fp32, too. If not, ``eager`` tells what the original took in another
            process, before, and nothing is told of precisions.
        threads: of all calls.
        clock: by which they are timed; ``eager``, too.
    """
    torch.set_num_threads(threads)
    artifact = load_artifact(folder / "compiled")
    precisions = ("fp32", lowered(artifact)) if exact else (lowered(artifact),)
    policy = open_policy(artifact, threads=threads, plan=artifact.plan(f"dense@{precisions[0]}"))
    obs, noise = call(spec)
    times = Times(Arithmetic(artifact), threads, clock)
    halves = exact and not {"amx_bf16", "avx512_bf16"}.isdisjoint(cpuinfo().get("flags", "").split())
    for _ in range(rounds + 1):  # the first does not count
        times.next_round()
        expected, split = eager()
        if halves:
            with torch.autocast("cpu", torch.bfloat16):
                rounded, seconds = eager()
        for precision in precisions:
            for name, plan in plans_of(artifact, precision, computed).items():
                policy.forget_frames()  # every call sees the same observation
                found = timed(policy, obs, noise, plan, times, precision, f"{name}, {precision}")
                if (name, precision) == ("dense", precisions[0]):
                    error = float(np.abs(found - expected).max())
                    assert policy.last_report is not None
                    times.add(f"eager: {parts}", "fp32", split, policy.last_report)
                    if halves:
                        times.add(f"eager, autocast: {parts}", "bf16", seconds, policy.last_report)
    times.tell(1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    told = f"the dense call, {precisions[0]}, from eager; {peak:.2f} GiB at most, all of them loaded"
    print(f"{error:8.1e}  {told}")
    if halves:
        print(f"{np.abs(rounded - expected).mean():8.2g}  eager in bf16 by autocast, from eager in fp32 on average")
    if exact:
        tell_precision(artifact, policy)


def tell_precision(artifact: Artifact, policy: CompiledPolicy) -> None:
    """Print how far fewer bits move dense actions, all parts together and each alone, and how far other noise does."""
    record, exact = artifact.manifest.precision, artifact.plans["dense"]
    assert record is not None
    lower = dict.fromkeys(record.kept, record.name)
    parts = {f"{part} alone": {part: record.name} for part in record.kept} if len(record.kept) > 1 else {}
    plans = {name: replace(exact, precision=own) for name, own in {"dense actions": lower, **parts}.items()}
    calls = random_calls(artifact.manifest.spec, COMPARED, seed=8)
    moved: dict[str, list[float]] = {name: [] for name in (*plans, "other noise")}
    for number, (obs, noise) in enumerate(calls):

        def actions(plan: Plan, noise: Noise, obs: Mapping[str, np.ndarray] = obs) -> np.ndarray:
            policy.reset()
            return np.asarray(policy.predict_action(obs, noise=noise, plan=plan)["action"])

        expected = actions(exact, noise)
        made = {name: actions(plan, noise) for name, plan in plans.items()}
        made["other noise"] = actions(exact, calls[number - 1][1])
        for name, found in made.items():
            moved[name].append(float(np.abs(found - expected).mean()))
    told = (f"{name} {statistics.mean(values):.2g}" for name, values in moved.items())
    print(f"{record.told}, from fp32 on average: {'; '.join(told)}")


def lowered(artifact: Artifact) -> str:
    """The precision that an artifact has beside fp32."""
    record = artifact.manifest.precision
    assert record is not None
    return record.name


def plans_of(artifact: Artifact, precision: str, computed: int, tokens: TokenReuse | None = None) -> dict[str, Plan]:
    """The dense plan in a precision, and one of whole steps, evenly spaced."""
    dense, steps = replace(artifact.plan(f"dense@{precision}"), tokens=tokens), artifact.manifest.steps
    few = np.full((steps, len(artifact.manifest.blocks)), ttscompile.Source.TIMESTEP, np.int8)
    few[np.arange(computed) * steps // computed] = ttscompile.Source.COMPUTE
    return {"dense": dense, f"{computed} of {steps} steps": replace(dense, cells=few)}


def timed(
    policy: CompiledPolicy,
    obs: Mapping[str, np.ndarray],
    noise: Noise,
    plan: Plan,
    times: Times,
    precision: str,
    name: str,
) -> np.ndarray:
    """The actions of a call; its seconds before the loop and in it go to ``times``."""
    start = times.clock()
    found = policy.predict_action(obs, noise=noise, plan=plan)["action"]
    took = times.clock() - start
    assert policy.last_report is not None
    timings = policy.last_report.timings
    before = took * timings.prologue / timings.total
    times.add(f"{name}: {PARTS}", precision, [before, took - before], policy.last_report)
    return np.asarray(found)


def reusing(
    folder: Path, spec: PolicySpec, computed: int, rounds: int = 7, threads: int = 1, clock: Clock = process_time
) -> None:
    """Calls in fewer bits with new frames, in which only an arm moves: all tokens, and those that changed.

    Args:
        folder: with the artifact.
        spec: of the policy.
        computed: how many steps the sparse plan computes.
        rounds: that are counted, of a frame for each plan.
        threads: of all calls.
        clock: by which they are timed.
    """
    artifact = load_artifact(folder / "compiled")
    bits = lowered(artifact)
    plans, reused = plans_of(artifact, bits, computed), plans_of(artifact, bits, computed, REUSE)
    whole, some = (open_policy(artifact, threads=threads, seed=0, plan=each["dense"]) for each in (plans, reused))
    times, rng = Times(Arithmetic(artifact), threads, clock), np.random.default_rng(1)
    obs, noise = call(spec)
    other = Noise(rng.standard_normal(noise.initial.shape, dtype=np.float32))
    still = backgrounds(obs, rng)
    shares, off, changes = list[float](), dict[str, list[float]](), dict[str, list[float]]()
    for number in range(len(plans) * (rounds + 2)):
        times.next_round()
        name, plan = list(plans.items())[number % len(plans)]
        for place, (key, background) in enumerate(still.items()):
            ages = reversed(range(obs[key].shape[1]))
            angles = [place + 0.05 * max(number - age, 0) for age in ages]
            obs[key] = np.stack([arm(background, angle) for angle in angles])[None]
        expected = timed(whole, obs, noise, plan, times, bits, f"{name}, {bits}, new frames, all tokens")
        found = timed(some, obs, noise, reused[name], times, bits, f"{name}, {bits}, new frames, some tokens")
        if number >= 2 * len(plans):  # the first is whole, and those that follow may be the first of their size
            assert some.last_report is not None
            frames = some.last_report.frames
            shares.append(frames.tokens / frames.of)
            off.setdefault(name, []).append(float(np.abs(found - expected).mean()))
            again = whole.predict_action(obs, noise=other, plan=plan)["action"]
            changes.setdefault(name, []).append(float(np.abs(again - expected).mean()))
    times.tell(2)
    print(f"{statistics.mean(shares):8.0%}  of the tokens of a new frame are computed")
    for name, values in off.items():
        mean, noisy = statistics.mean(values), statistics.mean(changes[name])
        print(f"{mean:8.2g}  {name}: actions off those with all tokens, on average; other noise {noisy:.2g}")
