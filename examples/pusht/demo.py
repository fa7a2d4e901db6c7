"""From a trained checkpoint to a compiled policy that drives Push-T: convert, record, calibrate, evaluate, time.

    python examples/pusht/demo.py

The demo compiles the policy with another sampler (DPM-Solver++, 16 steps where the original takes 100), predicts only
12 of the 16 actions, and calibrates for 6 computed steps of these 16. It then compares the result with the original on
episodes that it has not seen. That takes about twelve minutes on 2 cores; everything it makes is in ``build/pusht``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import click
from benchmark import CHECKPOINT, Measurement, speed_table, time_calls
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import ttscompile
from ttscompile.calibration.result import CalibrationResult
from ttscompile.core.plan import DENSE, FULL
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.plots.maps import plot_plan

sys.path.append(str(Path(__file__).resolve().parents[1] / "evaluation"))
from animate import save_animation
from bootstrap import Estimate, paired_difference
from environments.pusht import PushT
from episodes import Episodes
from evaluate import Evaluation, evaluate, evaluation_table
from jobs import Processes, fill_cache
from record import save_trajectories
from rollout import run_episodes
from variants import Variant, first_seed_option, open_variant, results_console, run, threads_option

BUILD = Path(__file__).resolve().parents[2] / "build" / "pusht"
SAMPLER, STEPS, HORIZON = "dpmsolver++", 16, 12
ORIGINAL, ALL_COMPUTED, COMPILED = "original", "16 steps, all computed", "compiled"
"""The three ways to run the policy, as the last table calls them."""


def progress_bar() -> Progress:
    """On standard error, gone when it is done."""
    return Progress(console=Console(stderr=True), transient=True)


def record_calls(artifact: Path, output: Path, episodes: int, batch: int, threads: int) -> str:
    """Drive Push-T with all of the 16 steps computed on seeds 0, 1, ... and write the observations.

    Returns:
        A line about it.
    """
    full = open_variant(f"{artifact}:{FULL}", "onnxruntime", threads)
    with progress_bar() as progress:
        task = progress.add_task("recording episodes", total=episodes)
        rollout = run_episodes(PushT, full, range(episodes), batch, lambda n: progress.update(task, completed=n))
    save_trajectories(output, [episode.windows for episode in rollout.episodes])
    return f"{sum(episode.calls for episode in rollout.episodes)} calls in {episodes} episodes"


def compare(artifact: Path, seeds: Sequence[int], batch: int, jobs: int) -> list[Evaluation]:
    """Evaluate the original, the 16 steps and the compiled policy on the same seeds, with the same initial noise.

    The original is run by onnxruntime, which gives the actions of the checkpoint's own code and takes less time.
    Episodes are kept beside the artifact, so that a second demo or ``evaluate.py`` need not run them again.
    """
    name, runtime, cache = "pusht", "onnxruntime", artifact.parent / "episodes"
    texts = {f"{artifact}:{DENSE}": ORIGINAL, f"{artifact}:{FULL}": ALL_COMPUTED, str(artifact): COMPILED}
    with progress_bar() as progress:
        tasks = {text: progress.add_task(f"evaluating: {label}", total=len(seeds)) for text, label in texts.items()}

        def finished(text: str, count: int) -> None:
            progress.update(tasks[text], completed=count)

        fill_cache(name, list(texts), seeds, batch, runtime, cache, Processes(jobs), finished)
    opened = [open_variant(text, runtime, 1) for text in texts]
    caches = [Episodes(cache, name, variant, runtime) for variant in opened]
    variants = [Variant(texts[v.label], v.policy, v.plan, v.noise) for v in opened]
    return evaluate(PushT, variants, seeds, batch, caches=caches)


def time_alone(artifact: Path, checkpoint: Path, runs: int) -> list[Measurement]:
    """Time eager, all computed and compiled with one thread each, in a process that has done nothing else."""
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as process:
        measurements: list[Measurement] = process.submit(time_calls, artifact, checkpoint, runs, threads=1).result()
    return measurements


def calibration_table(result: CalibrationResult) -> Table:
    """The plans that calibration judged, on the episodes that it did not learn from."""
    title = f"distance from the original on {result.calls['validation']} observations that were held out"
    table = Table(title=title, caption="1: as far as other noise moves the original's actions")
    table.add_column("plan")
    for column in ("distance", "95 % interval", "cells reused", "FLOPs saved"):
        table.add_column(column, justify="right")
    for name, score in result.plans.items():
        table.add_row(
            f"{name} (default)" if name == result.default_plan else name,
            f"{score.distance:.3f}",
            "[{:.3f}, {:.3f}]".format(*score.interval),
            f"{score.sparsity:.1%}",
            f"{score.flops_saved:.1%}",
        )
    return table


def successes(evaluation: Evaluation) -> list[float]:
    """1 for each episode that covered the goal, else 0."""
    return [float(episode.success) for episode in evaluation.rollout.episodes]


def percent(estimate: Estimate, sign: str = "") -> str:
    """A share with its interval, in percent."""
    return f"{estimate.mean:{sign}.0%} [{estimate.low:{sign}.0%}, {estimate.high:{sign}.0%}]"


def difference(estimate: Estimate | None) -> str:
    """A difference of scores with its interval; nothing for what the others are compared with."""
    return "" if estimate is None else f"{estimate.mean:+.3f} [{estimate.low:+.3f}, {estimate.high:+.3f}]"


def final_table(speeds: Sequence[Measurement], evaluations: Sequence[Evaluation]) -> Table:
    """The three ways to run the policy, side by side: speed of one call, and how well they do on the same episodes."""
    first = speeds[0]
    full, compiled = evaluations[1:]
    from_full = paired_difference(successes(compiled), successes(full))
    episodes = len(evaluations[0].rollout.episodes)
    table = Table(title=f"Push-T, the same {episodes} episodes for each; in brackets 95 % intervals")
    table.add_column("")
    for label in (ORIGINAL, ALL_COMPUTED, COMPILED):
        table.add_column(label, justify="right")
    table.add_row("ms a call, 1 thread", *(f"{m.median:.1f}" for m in speeds))
    table.add_row("times faster than the original", *(f"{first.median / m.median:.1f}" for m in speeds))
    table.add_row("calls a second", *(f"{1000 / m.median:.1f}" for m in speeds))
    table.add_row("GFLOP a call", *(f"{m.flops / 1e9:.2f}" for m in speeds))
    table.add_row("blocks reused, not computed", *(f"{m.sparsity:.1%}" for m in speeds))
    table.add_row("score, at most 1", *(str(e.score) for e in evaluations))
    table.add_row("   its difference from the original", *(difference(e.score_difference) for e in evaluations))
    table.add_row("success", *(percent(e.success) for e in evaluations))
    table.add_row(
        "   its difference from the original",
        *("" if e.success_difference is None else percent(e.success_difference, "+") for e in evaluations),
    )
    table.add_row("   its difference from all computed", "", "", percent(from_full, "+"))
    return table


def conclusion(speeds: Sequence[Measurement], evaluations: Sequence[Evaluation]) -> str:
    """What the table means: the speed, and whether success was kept."""
    original, compiled = speeds[0], speeds[-1]
    _, full, sparse = evaluations
    change = sparse.success_difference
    assert change is not None
    return (
        f"A compiled call takes {compiled.median:.0f} ms where the original takes {original.median:.0f} ms:"
        f" it is {original.median / compiled.median:.0f} times faster."
        f" {_told('the original', change)}"
        f" {_told('the same 16 steps, all computed', paired_difference(successes(sparse), successes(full)))}"
        f" These are {len(sparse.rollout.episodes)} episodes; docs/evidence/results.md has 200."
    )


def _told(other: str, change: Estimate) -> str:
    """Whether the compiled policy's success differs from another's."""
    if change.low <= 0 <= change.high:
        return f"Its success is not told apart from that of {other}: the interval of the difference contains 0."
    return f"Its success is {'higher' if change.mean > 0 else 'lower'} than that of {other}."


@click.command()
@click.option("--checkpoint", default=CHECKPOINT, show_default=True, type=click.Path(exists=True, path_type=Path))
@click.option("--directory", default=BUILD, show_default=True, type=click.Path(file_okay=False, path_type=Path))
@click.option("--record-episodes", default=16, show_default=True, type=click.IntRange(2))
@click.option("--calibration-minutes", default=6.0, show_default=True, type=click.FloatRange(min=0.1))
@click.option(
    "--target-sparsity",
    default=0.625,
    show_default=True,
    type=click.FloatRange(0, 1, max_open=True),
    help="Share of the blocks to reuse: of 16 steps 6 are computed.",
)
@click.option("--episodes", default=32, show_default=True, type=click.IntRange(1), help="Of the evaluation.")
@first_seed_option
@click.option("--runs", default=10, show_default=True, type=click.IntRange(1), help="Timed calls of each.")
@click.option("--batch", default=16, show_default=True, type=click.IntRange(1), help="Episodes in lockstep.")
@threads_option
@click.option("--jobs", type=click.IntRange(1), help="Processes that evaluate; one a core if you say nothing.")
def main(
    checkpoint: Path,
    directory: Path,
    record_episodes: int,
    calibration_minutes: float,
    target_sparsity: float,
    episodes: int,
    first_seed: int,
    runs: int,
    batch: int,
    threads: int,
    jobs: int | None,
) -> None:
    """Compile the Push-T policy, calibrate it, and compare it with the original."""
    console = results_console()
    directory.mkdir(parents=True, exist_ok=True)
    artifact, calls = directory / "compiled", directory / "calls.npz"
    machine = fingerprint()
    console.print(one_line(machine), highlight=False, soft_wrap=True)

    console.rule("1 of 5: convert, with the original loop and one of fewer steps")
    program = ttscompile.convert(checkpoint, artifact, sampler=SAMPLER, steps=STEPS, prediction_horizon=HORIZON)
    original = f"plan {DENSE}, {program.spec.sampler.steps} steps, {program.dense_flops / 1e9:.1f} GFLOP a call"
    console.print(f"{len(program.blocks)} residual blocks; the original: {original}")
    console.print(f"{SAMPLER}, {STEPS} steps, the first {HORIZON} actions: plan {FULL} of {artifact}")

    console.rule("2 of 5: record what the policy observes")
    console.print(f"{record_calls(artifact, calls, record_episodes, batch, threads)}: {calls}")

    console.rule("3 of 5: calibrate: which steps can do without computing?")
    result = ttscompile.calibrate(
        artifact, trajectories=[calls], target_sparsity=target_sparsity, seed=0, max_minutes=calibration_minutes
    )
    console.print(calibration_table(result))
    for name, reason in result.skipped.items():
        console.print(f"{name}: none, {reason}")

    console.rule("4 of 5: drive the robot with each")
    seeds = range(first_seed, first_seed + episodes)
    evaluations = compare(artifact, seeds, batch, jobs or machine["cores"])
    console.print(evaluation_table(PushT.title, evaluations, seeds))

    console.rule("5 of 5: time one call")
    speeds = time_alone(artifact, checkpoint, runs)
    console.print(speed_table(speeds, threads=1))

    console.rule("result")
    console.print(final_table(speeds, evaluations))
    console.print(conclusion(speeds, evaluations), highlight=False)
    picture, animation = directory / "plan.png", directory / "episode.gif"
    kinds = [block.kind for block in program.blocks]
    plan = speeds[-1].plan
    if plan is not None:
        plot_plan(plan, kinds, picture)
        console.print(f"which blocks one call computes: {picture}")
    pair = [evaluations[0].rollout.episodes[0], evaluations[-1].rollout.episodes[0]]
    save_animation(animation, PushT, pair, [ORIGINAL, COMPILED])
    console.print(f"the episode of seed {first_seed}, original and compiled: {animation}")
    console.print(f"everything on one page: .venv/bin/ttscompile inspect {artifact} -o page.html", soft_wrap=True)
    console.print("what to do with a policy of your own: docs/tutorial.md", soft_wrap=True)


if __name__ == "__main__":
    run(main)
