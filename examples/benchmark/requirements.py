"""What must be true of a calibrated artifact's speed and memory, measured and judged.

    python examples/benchmark/requirements.py build/pusht/transformer/compiled

One process times, call by call in turn and at every thread count: eager PyTorch, onnxruntime with every block
computed, the artifact's plan, its blocks back to back (the floor, see ``floor.py``), its tails back to back, and the
same network and plan with four times as many steps. All but the last run the loop of the plan. Then
tests/runtimes/soak.py makes thousands of calls in a process of its own, pinned to the core that does least at the
moment. Exit status 1: a requirement was measured and is not met.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import numpy as np
from commands import numbers
from floor import FLOOR, TAILS, blocks_contestant, floor_ms, tails_contestant
from networks import PUSHT, Network, sampler_of, store_plans
from rich.progress import Progress
from rich.table import Table
from rounds import DENSE, EAGER, Effort, eager_contestant, measure_in_passes, rounds_of, tenths

import ttscompile
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.cli.contestants import original_policy
from ttscompile.cli.output import manifest_of, only_results_on_stdout, print_json, progress, results_console, run, table
from ttscompile.core.lattice import PlanArray, dense_plan
from ttscompile.core.plan import ORIGINAL
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.report.timing import Contestant, Measurement, plan_contestant
from ttscompile.runtimes.random_calls import Observation, random_calls

OURS, LONGER = "compiled", "compiled, longer loop"
GROWTH = 4
"""How many times as many steps the longer loop has."""
SOAK = Path(__file__).resolve().parents[2] / "tests" / "runtimes" / "soak.py"
GROWTH_NEEDS = 4000
"""Calls: with fewer, pages that are touched for the first time look like growth."""


@dataclass(frozen=True)
class Settings:
    """How much is measured.

    Attributes:
        threads: thread counts; 1 is always among them.
        effort: how often everything is called.
        warm_calls: for the 50th and the 99th percentile.
        soak_calls: for memory and repeatability.
    """

    threads: tuple[int, ...]
    effort: Effort
    warm_calls: int
    soak_calls: int


FULL = Settings(threads=(1, 2, 4), effort=Effort(runs=8, passes=2), warm_calls=2000, soak_calls=10_000)
QUICK = Settings(threads=(1, 2), effort=Effort(runs=2, passes=1), warm_calls=120, soak_calls=200)


@dataclass(frozen=True)
class Requirement:
    """One line of the table.

    Attributes:
        what: for people.
        required: for people.
        measured: for people.
        value: the figure that is judged.
        met: None if too little was measured to say.
    """

    what: str
    required: str
    measured: str
    value: float
    met: bool | None


@dataclass(frozen=True, eq=False)
class Subject:
    """What is judged.

    Attributes:
        directory: the artifact.
        artifact: loaded.
        network: that it was made from, with the loop of the plan.
        plan_name: the plan.
        plan: int8 ``[K, blocks]``, as a call executed it.
    """

    directory: Path
    artifact: Artifact
    network: Network
    plan_name: str
    plan: PlanArray


def subject(directory: Path, checkpoint: Path, plan_name: str | None) -> Subject:
    """The artifact and the network that it was made from.

    Raises:
        TtscompileError: one of them cannot be had, or there is no such plan.
    """
    manifest = load_artifact(directory).manifest
    module, _ = original_policy(checkpoint, manifest.spec)
    width = int(manifest.blocks[0].type.at(1)[-1])
    return subject_of(directory, Network(checkpoint.stem, width, module, manifest.spec), plan_name)


def subject_of(directory: Path, network: Network, plan_name: str | None) -> Subject:
    """The same for a network in memory."""
    artifact = load_artifact(directory)
    name = plan_name or artifact.manifest.default_plan
    policy, spec = ttscompile.load(directory, plan=name), view_of(artifact, name).manifest.spec
    for obs, noise in random_calls(spec, 2, seed=0):  # the first one of an episode may be repaired
        policy.predict_action(obs, noise=noise, plan=name)
    report = policy.last_report
    assert report is not None
    return Subject(directory, artifact, replace(network, spec=spec), name, report.plan[0])


def time_calls(
    of: Subject, settings: Settings, announce: Callable[[str, int], Callable[[], None]]
) -> dict[int, dict[str, Measurement]]:
    """All contestants at all thread counts: by number of threads, by label."""
    spec, manifest = of.network.spec, of.artifact.manifest
    eager = eager_contestant(of.network, manifest.flops.dense / manifest.steps * spec.sampler.steps)
    with TemporaryDirectory() as folder:
        announce(f"compiling with {GROWTH} times the steps", 1)
        longer = _compile_longer(of, Path(folder))
        by_threads: dict[int, list[Contestant]] = {}
        for threads in sorted({1, *settings.threads}):
            policy = ttscompile.load(of.directory, threads=threads, plan=of.plan_name)
            by_threads[threads] = [
                eager,
                _in_full(of, threads),
                plan_contestant(OURS, policy, of.plan_name, spec),
                blocks_contestant(of.directory, threads, of.plan_name),
                tails_contestant(of.directory, threads, of.plan, of.plan_name),
            ]
        by_threads[1].append(longer)
        on_round = announce("timing", rounds_of(by_threads, settings.effort))
        measured = measure_in_passes(by_threads, settings.effort, on_round)
    return {threads: {m.label: m for m in measurements} for threads, measurements in measured.items()}


def _in_full(of: Subject, threads: int) -> Contestant:
    """The loop of the plan in its precision, with every block computed; with a policy, and caches, of its own."""
    cells = dense_plan(*of.plan.shape)
    whole = replace(of.artifact.plan(of.plan_name), cells=cells, correction=None, weights=ORIGINAL)
    policy = ttscompile.load(of.directory, threads=threads, plan=whole)

    def call(obs: Observation, noise: ttscompile.Noise) -> object:
        return policy.predict_action(obs, noise=noise)

    return Contestant(DENSE, "dense", call, lambda: policy.last_report, of.network.spec, 0.0)


def _compile_longer(of: Subject, directory: Path) -> Contestant:
    """The same network with ``GROWTH`` times the steps, and a plan in which each step of the given one is repeated."""
    steps = GROWTH * len(of.plan)
    spec = replace(of.network.spec, sampler=sampler_of(of.network.spec.sampler.name, steps))
    ttscompile.compile_denoiser(of.network.module, spec, directory)
    store_plans(directory, {"longer": np.repeat(of.plan, GROWTH, axis=0)})
    return plan_contestant(LONGER, ttscompile.load(directory), "longer", spec)


def soak(directory: Path, calls: int, plan_name: str) -> dict[str, Any]:
    """What tests/runtimes/soak.py says after so many calls at one thread, pinned to the idlest core."""
    command = [sys.executable, str(SOAK), str(directory), "--calls", str(calls), "--plan", plan_name]
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {idlest_core()})  # of this thread; the process that it starts inherits it
    try:
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    finally:
        os.sched_setaffinity(0, allowed)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def idlest_core(seconds: float = 0.5) -> int:
    """Of the cores that this process may use, the one that was idle most of that time."""

    def idle() -> dict[int, int]:
        fields = (line.split() for line in Path("/proc/stat").read_text().splitlines())
        return {int(f[0][3:]): int(f[4]) for f in fields if f[0].startswith("cpu") and f[0] != "cpu"}

    before = idle()
    time.sleep(seconds)
    after = idle()
    return max(os.sched_getaffinity(0), key=lambda core: after[core] - before[core])


def judge(
    of: Subject, timed: Mapping[int, Mapping[str, Measurement]], warm: Mapping[str, Any], long: Mapping[str, Any]
) -> list[Requirement]:
    """The table of the requirements.

    Args:
        of: what was measured.
        timed: by number of threads, by label.
        warm: what the soak said about latency.
        long: what it said about memory and repeatability.
    """
    one = timed[1]
    ours, eager, dense = (one[label].median_ms for label in (OURS, EAGER, DENSE))
    best = {label: min(timed, key=lambda threads: timed[threads][label].median_ms) for label in (OURS, EAGER)}
    best_eager, best_ours = timed[best[EAGER]][EAGER].median_ms, timed[best[OURS]][OURS].median_ms
    floor = floor_ms(of.plan, of.artifact, one[FLOOR])
    steps, growth = len(of.plan), one[LONGER].median_ms / ours / GROWTH
    tail = warm["p99_ms"] / warm["p50_ms"]
    weights = sum(array.nbytes for array in of.artifact.weights.values()) / 2**20
    above = max(long["rss_mb"]) - long["before_load_mb"] - weights
    grown = long["growth_kb_a_call"]
    best_threads = f"{best[EAGER]} and {best[OURS]}"
    return [
        _at_least(45, eager / ours, "against eager PyTorch, 1 thread each", f"{eager:.0f} / {ours:.2f} ms"),
        _at_least(
            40,
            best_eager / best_ours,
            f"against eager PyTorch, each at its best thread count ({best_threads}); 60x is the goal",
            f"{best_eager:.0f} / {best_ours:.2f} ms",
        ),
        _at_least(12, dense / ours, "against dense onnxruntime, 1 thread", f"{dense:.0f} / {ours:.2f} ms"),
        _at_most(1.3, ours / floor, "time / arithmetic floor, 1 thread", f"{ours:.2f} / {floor:.2f} ms"),
        Requirement(
            f"time from K = {steps} to K = {GROWTH * steps} at equal sparsity, over {GROWTH}",
            "0.9 to 1.1",
            f"{growth:.3f} ({ours:.2f} to {one[LONGER].median_ms:.2f} ms)",
            growth,
            bool(0.9 <= growth <= 1.1),
        ),
        _at_most(
            1.5,
            tail,
            f"p99 / p50 of {warm['calls']} warm calls, pinned to the idlest core",
            f"{warm['p99_ms']:.2f} / {warm['p50_ms']:.2f} ms",
        ),
        _at_most(
            64, above, "MB above the weights, one stream, onnxruntime itself included", f"weights {weights:.1f} MB"
        ),
        Requirement(
            f"growth of memory over {long['calls']} calls in episodes of 40",
            "none (below 0.1 kB a call)",
            f"{grown:.3f} kB a call" + ("" if long["calls"] >= GROWTH_NEEDS else " (too few calls to judge)"),
            grown,
            bool(grown < 0.1) if long["calls"] >= GROWTH_NEEDS else None,
        ),
        Requirement(
            "two episodes of one seed, first and last",
            "same bits",
            "same bits" if long["repeatable"] else "different",
            float(long["repeatable"]),
            bool(long["repeatable"]),
        ),
    ]


def _at_least(limit: float, value: float, what: str, detail: str) -> Requirement:
    return Requirement(what, f"at least {limit:g}x", f"{value:.1f}x ({detail})", value, bool(value >= limit))


def _at_most(limit: float, value: float, what: str, detail: str) -> Requirement:
    return Requirement(what, f"at most {limit:g}", f"{value:.3g} ({detail})", value, bool(value <= limit))


def profile(of: Subject, one: Mapping[str, Measurement]) -> dict[str, float]:
    """Where the milliseconds of a call at one thread go; ``rest`` is additions, sums and the loop itself."""
    parts = {
        "computed cells (the floor)": floor_ms(of.plan, of.artifact, one[FLOOR]),
        f"{len(of.plan)} tails, sampler steps and stems": one[TAILS].median_ms,
        "prologue": one[OURS].parts_ms["prologue"],
    }
    return parts | {"rest": one[OURS].median_ms - sum(parts.values())}


def requirements_table(requirements: Sequence[Requirement]) -> Table:
    """Required, measured, verdict."""
    made = table("requirement", "required", "measured", "")
    for one in requirements:
        made.add_row(one.what, one.required, one.measured, {True: "met", False: "NOT MET", None: "not judged"}[one.met])
    return made


@click.command()
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@click.option("--checkpoint", default=PUSHT, type=click.Path(exists=True, path_type=Path), help="Its source.")
@click.option("--plan", help="Of the artifact; its default plan if not given.")
@click.option("--threads", callback=numbers, help="Thread counts.  [default: 1,2,4]")
@click.option("--quick", is_flag=True, help="Few calls: shows that all of it runs; the figures are rough.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document instead of the table.")
def main(
    directory: Path, checkpoint: Path, plan: str | None, threads: tuple[int, ...] | None, quick: bool, as_json: bool
) -> None:
    """Measure what is required of the artifact DIRECTORY, which CHECKPOINT was converted to."""
    settings = QUICK if quick else FULL
    if threads is not None:
        settings = replace(settings, threads=threads)
    of = subject(directory, checkpoint, plan)
    sys.exit(judge_and_tell(of, settings, as_json))


def judge_and_tell(of: Subject, settings: Settings, as_json: bool) -> int:
    """Measure, print, and give the exit status."""
    with Progress(console=progress()) as bar, only_results_on_stdout():

        def announce(text: str, total: int) -> Callable[[], None]:
            task = bar.add_task(text, total=total)
            return lambda: bar.advance(task)

        timed = time_calls(of, settings, announce)
        announce(f"{settings.warm_calls} and {settings.soak_calls} calls", 1)
        warm = soak(of.directory, settings.warm_calls, of.plan_name)
        long = soak(of.directory, settings.soak_calls, of.plan_name)
    found = judge(of, timed, warm, long)
    parts = profile(of, timed[1])
    if as_json:
        calls = [
            {"threads": threads, "p10_p90_ms": tenths(m.times_ms), **m.to_json()}
            for threads, of_label in timed.items()
            for m in of_label.values()
        ]
        print_json(
            {
                "identity": manifest_of(of.directory).identity,
                "machine": fingerprint(),
                "settings": asdict(settings),
                "plan": of.plan_name,
                "requirements": [asdict(one) for one in found],
                "profile_ms": parts,
                "calls": calls,
                "warm": warm,
                "soak": long,
            }
        )
    else:
        output = results_console()
        output.print(requirements_table(found))
        output.print(f"plan {of.plan_name!r}; a call at 1 thread: ", end="", markup=False)
        output.print(", ".join(f"{name} {ms:.2f} ms" for name, ms in parts.items()), soft_wrap=True)
        output.print(one_line(fingerprint()), markup=False, soft_wrap=True)
    return int(any(one.met is False for one in found))


if __name__ == "__main__":
    run(main)
