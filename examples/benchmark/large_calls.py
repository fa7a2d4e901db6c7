"""Calls of a large policy, timed for ``large.py``: PyTorch and compiled, and with tokens reused where an arm moves.

Seconds are the processor's: all calls are on one thread, and the machine may be busy. Contestants take turns, and with
them a product that says what the arithmetic of their calls takes alone (``rate.py``): the floor.
"""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from large_smolvla import call
from moving import REUSE, arm, picture
from rate import rates, run_all

import ttscompile
from ttscompile import Noise, PolicySpec
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.ir.flops import graph_flops
from ttscompile.runtimes.info import PolicyInfo
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.report import CallReport


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
    """What the calls of all contestants took, in turn with the products of the floor."""

    def __init__(self, arithmetic: Arithmetic) -> None:
        self._arithmetic, self._products = arithmetic, rates()
        self._calls: dict[str, _Calls] = {}

    def add(self, name: str, precision: str, seconds: list[float], report: CallReport) -> None:
        """A call of a contestant, which computed what the report says."""
        calls = self._calls.setdefault(name, _Calls(precision))
        calls.seconds.append(seconds)
        calls.flops.append(self._arithmetic.of(report))

    def next_round(self) -> None:
        """Time the products of the floor."""
        run_all(self._products.values())

    def tell(self, left_out: int) -> None:
        """Print medians of all but the first calls."""
        for name, calls in self._calls.items():
            seconds, flops = calls.seconds[left_out:], calls.flops[left_out:]
            total = statistics.median(map(sum, seconds))
            parts = ", ".join(f"{statistics.median(part):.2f}" for part in zip(*seconds, strict=True))
            least = [
                self._products[calls.precision].seconds(statistics.mean(part)) for part in zip(*flops, strict=True)
            ]
            floor = f"floor {sum(least):.3f}: {', '.join(f'{part:.3f}' for part in least)}"
            print(f"{total:8.2f} s  {name}: {parts}; {floor}; {total / sum(least):.2f} times it", flush=True)


def compare(
    folder: Path,
    parts: str,
    eager: Callable[[], tuple[np.ndarray, list[float]]],
    spec: PolicySpec,
    computed: int,
    rounds: int = 5,
) -> None:
    """One call after the other, in turn: eager, dense and with few computed steps, in fp32 and in int8.

    Seconds are the processor's: all calls are on one thread, and the machine may be busy.

    Args:
        folder: with the artifact.
        parts: what ``eager`` takes the time of.
        eager: a call of the original.
        spec: of the policy.
        computed: how many steps the sparse plan computes.
        rounds: that are counted.
    """
    torch.set_num_threads(1)
    record = load_artifact(folder / "compiled").manifest.precision
    assert record is not None
    policies = {name: ttscompile.load(folder / "compiled", plan=f"full@{name}") for name in ("fp32", "int8")}
    info = policies["fp32"].info
    obs, noise = call(spec)
    plans = plans_of(info, computed)
    times = Times(Arithmetic(load_artifact(folder / "compiled")))
    for _ in range(rounds + 1):  # the first does not count
        times.next_round()
        expected, split = eager()
        for precision, policy in policies.items():
            for name, plan in plans.items():
                policy.forget_frames()  # every call sees the same observation
                found = timed(policy, obs, noise, plan, times, precision, f"{name}, {precision}")
                if (name, precision) == ("dense", "fp32"):
                    exact, error = found, float(np.abs(found - expected).max())
                    assert policy.last_report is not None
                    times.add(f"eager: {parts}", precision, split, policy.last_report)
                elif name == "dense":
                    apart = float(np.abs(found - exact).max())
    times.tell(1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{error:8.1e}  the dense call from eager; {peak:.2f} GiB at most, all of them loaded")
    print(f"{record.told}: a dense call up to {apart:.2g} from fp32")


def plans_of(info: PolicyInfo, computed: int) -> dict[str, Any]:
    """The dense plan, and one of whole steps, evenly spaced."""
    few = np.full((info.K, len(info.blocks)), ttscompile.Source.TIMESTEP, np.int8)
    few[np.arange(computed) * info.K // computed] = ttscompile.Source.COMPUTE
    return {"dense": 0 * few, f"{computed} of {info.K} steps": few}


def timed(
    policy: CompiledPolicy,
    obs: Mapping[str, np.ndarray],
    noise: Noise,
    plan: Any,
    times: Times,
    precision: str,
    name: str,
) -> np.ndarray:
    """The actions of a call; its seconds before the loop and in it go to ``times``."""
    start = time.process_time()
    found = policy.predict_action(obs, noise=noise, plan=plan)["action"]
    took = time.process_time() - start
    assert policy.last_report is not None
    timings = policy.last_report.timings
    before = took * timings.prologue / timings.total
    times.add(f"{name}: prologue, loop", precision, [before, took - before], policy.last_report)
    return np.asarray(found)


def reusing(folder: Path, spec: PolicySpec, computed: int, rounds: int = 7) -> None:
    """Calls in int8 with a new frame of every camera, in which only an arm moves: all tokens, and those that changed.

    Args:
        folder: with the artifact.
        spec: of the policy.
        computed: how many steps the sparse plan computes.
        rounds: that are counted, of a frame for each plan.
    """
    artifact = load_artifact(folder / "compiled").at_precision("int8")
    whole, some = (open_policy(each, seed=0) for each in (artifact, artifact.with_reuse(REUSE)))
    plans, times, rng = plans_of(whole.info, computed), Times(Arithmetic(artifact)), np.random.default_rng(1)
    obs, noise = call(spec)
    other = Noise(rng.standard_normal(noise.initial.shape, dtype=np.float32))
    cameras = [key for key, value in obs.items() if value.ndim == 5]  # [1, frames, 3, H, W]
    still = {key: picture(obs[key].shape[-1], rng) for key in cameras}
    shares, off, changes = list[float](), dict[str, list[float]](), dict[str, list[float]]()
    for number in range(len(plans) * (rounds + 2)):
        times.next_round()
        name, plan = list(plans.items())[number % len(plans)]
        for place, (key, background) in enumerate(still.items()):
            ages = reversed(range(obs[key].shape[1]))
            angles = [place + 0.05 * max(number - age, 0) for age in ages]
            obs[key] = np.stack([arm(background, angle) for angle in angles])[None]
        expected = timed(whole, obs, noise, plan, times, "int8", f"{name}, int8, new frames, all tokens")
        found = timed(some, obs, noise, plan, times, "int8", f"{name}, int8, new frames, some tokens")
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
