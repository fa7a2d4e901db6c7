"""Time one call of the Push-T policy: eager PyTorch, dense onnxruntime, and sparse, in one run on one machine.

    python examples/pusht/benchmark.py build/pusht/transformer/compiled --threads 1

One stream, warm calls of one episode. The contestants take turns, call by call, on the same observation and noise, so
that whatever else the machine does hits all of them; the table has medians and the quartiles around them. One thread
is the fair comparison on a machine that has anything else to do: PyTorch's threads wait for each other after every
small operation, and where they have to share cores an eager call can take ten times as long as with one thread.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
from original import EagerPolicy
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import ttscompile
from ttscompile import Source
from ttscompile.artifact.load import load_artifact, read_manifest
from ttscompile.cli.output import print_identity
from ttscompile.core.plan import DENSE, FULL
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.measure.timer import Timer, Times
from ttscompile.runtimes.info import PolicyInfo

sys.path.append(str(Path(__file__).resolve().parents[1] / "evaluation"))
from environments.pusht import FloatArray, PushT
from variants import NoiseShape, Plan, Policy, full_plan, noise_shape, results_console, run, seeded_noise

CHECKPOINT = Path(__file__).with_name("pusht_dpt_ema_fp16.ckpt")
WARM_UP = 3
"""Calls before the first that counts; the first of them computes all, so that every cache is written."""


@dataclass(frozen=True)
class Contestant:
    """One way to make a call.

    Attributes:
        label: for the table.
        policy: of its own; no caches are shared.
        plan: as in ``predict_action``; None for the one that the policy was loaded with.
        dense_flops: FLOPs of a call without a report, which computes everything.
        noise: sizes of the random numbers of a call. Contestants with another sampler share the initial noise.
    """

    label: str
    policy: Policy | EagerPolicy
    plan: Plan | None
    dense_flops: float
    noise: NoiseShape


@dataclass(frozen=True)
class Measurement:
    """What the calls of one contestant took.

    Attributes:
        label: of the contestant.
        ms: wall time of each counted call.
        prologue_ms: median of the report's timing; None without reports.
        pruner_ms: likewise.
        flops: median of a call.
        sparsity: mean share of reused cells.
        plan: of the last call, int8 ``[K, blocks]``; None without reports.
    """

    label: str
    ms: tuple[float, ...]
    prologue_ms: float | None
    pruner_ms: float | None
    flops: float
    sparsity: float
    plan: npt.NDArray[np.int8] | None

    @property
    def median(self) -> float:
        """Milliseconds a call."""
        return Times(self.ms).median

    @property
    def quartiles(self) -> tuple[float, float]:
        """First and third quartile, milliseconds."""
        return Times(self.ms).quartiles


def random_plan(steps: int, blocks: int, computed: float, seed: int) -> npt.NDArray[np.int8]:
    """A plan that is legal once every rollout cache is written: step 0 dense, the other computed cells anywhere.

    Args:
        steps: K.
        blocks: number of blocks.
        computed: share of all cells that is computed, step 0 included.
        seed: of the draw.

    Returns:
        int8 ``[K, blocks]``; reused cells are drawn evenly from the three sources.
    """
    rng = np.random.default_rng(seed)
    plan = rng.choice([Source.FORWARD, Source.TIMESTEP, Source.ROLLOUT], size=(steps, blocks)).astype(np.int8)
    plan[0] = Source.COMPUTE
    more = max(round(computed * steps * blocks) - blocks, 0)
    plan[1:].reshape(-1)[rng.permutation((steps - 1) * blocks)[:more]] = Source.COMPUTE
    return plan


def scripted_windows(count: int) -> list[FloatArray]:
    """Observations of consecutive calls while the agent goes round in a circle, ``[1, 2, 20]`` each."""
    environment = PushT()
    environment.reset(seed=0)
    frames = [environment.observe()["obs"]] * 2
    for angle in 0.1 * np.arange(8 * count):
        environment.step(256 + 120 * np.array([np.cos(angle), np.sin(angle)]))
        frames.append(environment.observe()["obs"])
    return [np.stack(frames[8 * call : 8 * call + 2])[None] for call in range(count)]


def measure(
    contestants: Sequence[Contestant], runs: int, on_run: Callable[[], None] = lambda: None
) -> list[Measurement]:
    """Time the contestants, one call each in turn, ``runs`` times.

    Args:
        contestants: at least one.
        runs: counted calls of each.
        on_run: called after each round.

    Returns:
        One measurement a contestant.
    """
    windows = scripted_windows(WARM_UP + runs)
    timer = Timer(len(contestants), WARM_UP)
    reports: list[list[Any]] = [[] for _ in contestants]
    for contestant in contestants:
        contestant.policy.reset()
    for call, window in enumerate(windows):
        for i in timer.round():
            contestant = contestants[i]
            noise = seeded_noise(contestant.noise, [0], call)
            plan = contestant.plan
            if call == 0 and isinstance(plan, np.ndarray):
                plan = np.zeros_like(plan)
            timer.time(i, partial(contestant.policy.predict_action, {"obs": window}, noise=noise, plan=plan))
            if timer.counted:
                reports[i].append(getattr(contestant.policy, "last_report", None))
        on_run()
    return [_summary(c, times.ms, seen) for c, times, seen in zip(contestants, timer.times, reports, strict=True)]


def _summary(contestant: Contestant, ms: tuple[float, ...], reports: Sequence[Any]) -> Measurement:
    if reports[-1] is None:
        return Measurement(contestant.label, ms, None, None, contestant.dense_flops, 0.0, None)
    return Measurement(
        label=contestant.label,
        ms=ms,
        prologue_ms=float(np.median([report.timings.prologue for report in reports])),
        pruner_ms=float(np.median([report.timings.pruner for report in reports])),
        flops=float(np.median([report.flops[0] for report in reports])),
        sparsity=float(np.mean([np.mean(report.plan != Source.COMPUTE) for report in reports])),
        plan=reports[-1].plan[0],
    )


def speed_table(measurements: Sequence[Measurement], threads: int) -> Table:
    """Medians, spread and ratios; the first two rows are what the others are compared with."""
    first, second = measurements[0], measurements[min(1, len(measurements) - 1)]
    table = Table(title=f"one call, one stream, {threads} thread{'s' if threads > 1 else ''}, {len(first.ms)} runs")
    table.add_column("")
    for column in (
        "ms",
        "quartiles",
        "calls / s",
        f"times {first.label}",
        f"times {second.label}",
        "GFLOP",
        "sparsity",
        "prologue ms",
        "pruner ms",
    ):
        table.add_column(column, justify="right")
    for m in measurements:
        low, high = m.quartiles
        table.add_row(
            m.label,
            f"{m.median:.2f}",
            f"{low:.2f} - {high:.2f}",
            f"{1000 / m.median:.1f}",
            f"{first.median / m.median:.1f}",
            f"{second.median / m.median:.1f}",
            f"{m.flops / 1e9:.3f}",
            f"{m.sparsity:.1%}",
            "" if m.prologue_ms is None else f"{m.prologue_ms:.2f}",
            "" if m.pruner_ms is None else f"{m.pruner_ms:.2f}",
        )
    return table


def contestants_for(
    artifact: Path, checkpoint: Path, threads: int, given: npt.NDArray[np.int8] | None
) -> tuple[list[Contestant], PolicyInfo]:
    """Eager, all computed, a given plan if there is one, and the artifact's own; each with a policy of its own.

    Args:
        artifact: what ``ttscompile.convert`` made of the checkpoint, with the checkpoint's own sampler or another.
        checkpoint: for the eager policy, which keeps the checkpoint's own sampler.
        threads: of each.
        given: int8 ``[K, blocks]`` of the loop that was converted to, legal for warm calls.

    Returns:
        The contestants, and what the artifact says about itself and the plan that computes all.
    """
    full, default = full_plan(artifact), read_manifest(artifact).default_plan
    plans: list[tuple[str, str, Plan | None]] = [("dense onnxruntime", full, None)]
    if given is not None:
        plans.append((f"given plan, {np.mean(given != Source.COMPUTE):.0%} reused", full, given))
    if default not in (DENSE, FULL):
        plans.append(("compiled", default, None))
    policies = [ttscompile.load(artifact, threads=threads, plan=name) for _, name, _ in plans]
    original, info = EagerPolicy(checkpoint, threads), policies[0].info
    eager = Contestant("eager PyTorch", original, None, info.dense_flops, original.noise)
    others = [
        Contestant(label, policy, plan, info.dense_flops, noise_shape(policy.info))
        for (label, _, plan), policy in zip(plans, policies, strict=True)
    ]
    return [eager, *others], info


def time_calls(artifact: Path, checkpoint: Path, runs: int, threads: int) -> list[Measurement]:
    """Time eager, dense and compiled, with a progress bar on standard error."""
    contestants, _ = contestants_for(artifact, checkpoint, threads, None)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("timing", total=WARM_UP + runs)
        return measure(contestants, runs, lambda: progress.advance(task))


def fixed_shares(artifact: Path) -> dict[str, float]:
    """FLOPs of prologue and pruner, as shares of a dense call."""
    flops = load_artifact(artifact).manifest.flops
    return {"prologue": flops.prologue / flops.dense, "pruner": flops.pruner / flops.dense}


def to_json(measurements: Sequence[Measurement], shares: dict[str, float], threads: int) -> dict[str, Any]:
    """Everything that the tables say, and every single time."""
    contestants = []
    for m in measurements:
        fields = asdict(m)
        del fields["plan"]
        ratios = {f"times_{other.label}": other.median / m.median for other in measurements}
        contestants.append(fields | {"median_ms": m.median, "quartiles_ms": m.quartiles} | ratios)
    return {"machine": fingerprint(), "threads": threads, "flops_shares": shares, "contestants": contestants}


@click.command()
@click.argument("artifact", type=click.Path(exists=True, path_type=Path))
@click.option("--checkpoint", default=CHECKPOINT, show_default=True, type=click.Path(exists=True, path_type=Path))
@click.option("--runs", default=15, show_default=True, type=click.IntRange(1), help="Counted calls of each.")
@click.option("--threads", default=1, show_default=True, type=click.IntRange(1))
@click.option("--plan", "plan_file", type=click.Path(exists=True, path_type=Path), help="An .npy, int8 [K, blocks].")
@click.option("--computed", default=0.05, show_default=True, help="Share of computed cells of the random plan.")
@click.option("--seed", default=0, show_default=True, help="Of the random plan.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document instead of tables.")
def main(
    artifact: Path,
    checkpoint: Path,
    runs: int,
    threads: int,
    plan_file: Path | None,
    computed: float,
    seed: int,
    as_json: bool,
) -> None:
    """Time the policy of ARTIFACT; without --plan the given plan is a random one of 5 % computed cells."""
    info = ttscompile.load(artifact, threads=threads, plan=full_plan(artifact)).info
    if plan_file is None:
        given = random_plan(info.K, len(info.blocks), computed, seed)
    else:
        given = np.load(plan_file, allow_pickle=False)
    contestants, info = contestants_for(artifact, checkpoint, threads, given)
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("timing", total=WARM_UP + runs)
        measurements = measure(contestants, runs, lambda: progress.advance(task))
    shares = fixed_shares(artifact)
    if as_json:
        click.echo(json.dumps({"identity": info.identity, **to_json(measurements, shares, threads)}, indent=2))
        return
    console = results_console()
    console.print(speed_table(measurements, threads))
    console.print("of the dense FLOPs: " + ", ".join(f"{name} {share:.2%}" for name, share in shares.items()))
    print_identity(info.identity, console)
    console.print(one_line(fingerprint()), highlight=False)


if __name__ == "__main__":
    run(main)
