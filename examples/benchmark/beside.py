"""Calls of a policy that ``large.py`` compiled, in turn with another engine that has the same weights.

In every round both cameras have a new picture in which only an arm has moved. Tokens are reused by the last of our
plans, and the others compute all of it. Seconds are of the clock, so let the machine be quiet.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import click
import numpy as np
import numpy.typing as npt
from large_calls import lowered, plans_of
from large_smolvla import STATE, call
from moving import REUSE, arm, backgrounds

from ttscompile import Noise, Plan
from ttscompile.artifact.load import load_artifact
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy

Array = npt.NDArray[np.float32]

POLICIES = ("smolvla", "pi0", "pi05", "groot", "evo1", "vla_jepa")
"""Of ``large.py``, that another engine runs."""

COMPUTED = 2
"""Steps of the sparse plans."""

UNCOUNTED = 2
"""Rounds: where tokens are reused, the first frame is whole, and the second may be the first of its size."""


class Rival(Protocol):
    """Another engine."""

    parts: str
    """What ``predict`` takes the seconds of."""

    def predict(self, obs: Mapping[str, Array], noise: Noise) -> tuple[Array, list[float]]:
        """The actions ``[T, D]`` of a call, of padded channels too, and the seconds of its parts."""


def policy_of(folder: Path) -> str:
    """Which policy ``large.py`` left in the folder."""
    found = [name for name in POLICIES if (folder / name).is_dir()]
    if len(found) != 1:
        wanted = f"one folder of {', '.join(POLICIES)}, as large.py leaves it"
        raise SystemExit(f"{folder}: found {', '.join(found) or 'none'}; expected {wanted}.")
    return found[0]


def observed(folder: Path, words: int | None = None) -> tuple[dict[str, Array], Noise]:
    """One observation of the policy, and the noise of a call.

    The state is between -1 and 1, since vla.cpp clips some policies' there.

    Args:
        folder: with the artifact.
        words: how many tokens of the instruction count; None for all.
    """
    obs, noise = call(load_artifact(folder / "compiled").manifest.spec)
    made = {key: np.ones_like(value) for key, value in obs.items() if key.endswith("mask")}
    if words is not None:
        for mask in made.values():
            mask[..., words:] = False
    made |= {key: value.clip(-1, 1) for key, value in obs.items() if key == STATE}
    return obs | made, noise


def race_options(command: Callable[..., None]) -> Callable[..., None]:
    """The options of ``race``, which a command with any engine has."""
    for option in (
        click.option("--fp32/--no-fp32", default=True, help="Time ours in fp32, too, which takes memory."),
        click.option("--rounds", default=5, type=click.IntRange(1), help="That are counted."),
        click.option("--threads", default=1, type=click.IntRange(1), help="Of each engine."),
    ):
        command = option(command)
    return command


def race(
    folder: Path, rivals: Mapping[str, Rival], threads: int, rounds: int, fp32: bool = True, words: int | None = None
) -> None:
    """Time calls of everybody, in turn, and print medians; and how far actions are from ours in fp32.

    Args:
        folder: with the artifact.
        rivals: by name. The times of the first are what the others are told in.
        threads: of ours.
        rounds: that are counted.
        fp32: whether ours in fp32 runs, too, which takes memory; actions are then compared.
        words: see ``observed``.
    """
    artifact = load_artifact(folder / "compiled")
    (obs, noise), rng, bits = observed(folder, words), np.random.default_rng(1), lowered(artifact)
    plans = {name: plans_of(artifact, name, COMPUTED) for name in (("fp32", bits) if fp32 else (bits,))}
    policies = {name: open_policy(artifact, threads=threads, plan=own["dense"]) for name, own in plans.items()}
    few, reused = list(plans_of(artifact, bits, COMPUTED, REUSE).items())[-1]
    reusing = open_policy(artifact, threads=threads, plan=reused)
    still = backgrounds(obs, rng)
    times, found, off = dict[str, list[list[float]]](), dict[str, Array](), dict[str, list[float]]()
    for number in range(rounds + UNCOUNTED):
        for place, (key, background) in enumerate(still.items()):
            obs[key] = np.stack([arm(background, place + 0.05 * number)] * obs[key].shape[1])[None]
        for name, rival in rivals.items():
            found[name], seconds = rival.predict(obs, noise)
            times.setdefault(f"{name}: {rival.parts}", []).append(seconds)
        for precision, policy in policies.items():
            for name, plan in plans[precision].items():
                policy.forget_frames()
                found[f"{name}, {precision}"], seconds = timed(policy, obs, noise, plan)
                times.setdefault(f"{name}, {precision}: before the loop, loop", []).append(seconds)
        _, seconds = timed(reusing, obs, noise, reused)
        times.setdefault(f"{few}, {bits}, tokens reused: before the loop, loop", []).append(seconds)
        if fp32:
            exact = found["dense, fp32"]
            for name in (*rivals, f"dense, {bits}"):
                off.setdefault(name, []).append(float(np.abs(found[name][:, : exact.shape[1]] - exact).mean()))
    print("\n".join(told(times)))
    for name, values in off.items():
        size = float(np.abs(exact).mean())
        print(f"{statistics.mean(values):8.2g}  {name}: actions off ours in fp32 on average, of {size:.2g}")


def timed(policy: CompiledPolicy, obs: Mapping[str, Array], noise: Noise, plan: Plan) -> tuple[Array, list[float]]:
    """The actions ``[T, D]`` of a call of ours; and its seconds, of the clock: before the loop, and in it."""
    start = time.perf_counter()
    actions = policy.predict_action(obs, noise=noise, plan=plan)["action_pred"][0]
    took = time.perf_counter() - start
    assert policy.last_report is not None
    before = took * policy.last_report.timings.prologue / policy.last_report.timings.total
    return actions, [before, took - before]


def told(times: Mapping[str, Sequence[Sequence[float]]]) -> list[str]:
    """A line for each contestant: medians of its calls that count, and how many of them one call of the first takes."""
    first, lines = None, list[str]()
    for name, calls in times.items():
        counted = calls[UNCOUNTED:]
        total = statistics.median(map(sum, counted))
        first = first or total
        parts = ", ".join(f"{statistics.median(part):.2f}" for part in zip(*counted, strict=True))
        lines.append(f"{total:8.2f} s  {first / total:6.2f} times as fast as the first  {name}: {parts}")
    return lines
