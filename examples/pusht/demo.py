"""From a trained checkpoint to a compiled policy that drives Push-T: convert, record, calibrate, evaluate.

    python examples/pusht/demo.py

Takes about eleven minutes on 4 cores, half of which is calibration; everything it makes is in ``build/pusht``.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import click
from animate import save_animation
from benchmark import CHECKPOINT, Measurement, speed_table, time_calls
from evaluate import Evaluation, evaluate, evaluation_table
from record import save_trajectories
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rollout import run_episodes
from variants import Variant, first_seed_option, open_variant, results_console, run, threads_option

import ttscompile
from ttscompile.calibration.result import CalibrationResult
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.plots.plan import plot_plan

BUILD = Path(__file__).resolve().parents[2] / "build" / "pusht"


def progress_bar() -> Progress:
    """On standard error, gone when it is done."""
    return Progress(console=Console(stderr=True), transient=True)


def record_calls(artifact: Path, output: Path, episodes: int, batch: int, threads: int) -> str:
    """Drive Push-T with the dense policy on seeds 0, 1, ... and write its observations.

    Returns:
        A line about it.
    """
    dense = open_variant(f"{artifact}:dense", "onnxruntime", threads)
    with progress_bar() as progress:
        task = progress.add_task("recording episodes", total=episodes)
        rollout = run_episodes(
            dense.policy, range(episodes), dense.noise, batch, dense.plan, lambda n: progress.update(task, completed=n)
        )
    save_trajectories(output, rollout.episodes)
    return f"{sum(len(episode.windows) for episode in rollout.episodes)} calls in {episodes} episodes"


def compare(artifact: Path, seeds: Sequence[int], batch: int, threads: int) -> list[Evaluation]:
    """Evaluate dense and compiled on the same seeds, with the same noise."""
    opened = [open_variant(text, "onnxruntime", threads) for text in (f"{artifact}:dense", str(artifact))]
    variants = [
        Variant(label, v.policy, v.plan, v.noise) for label, v in zip(("dense", "compiled"), opened, strict=True)
    ]
    with progress_bar() as progress:
        tasks = {v.label: progress.add_task(f"evaluating {v.label}", total=len(seeds)) for v in variants}
        return evaluate(variants, seeds, batch, lambda label, n: progress.update(tasks[label], completed=n))


def time_alone(artifact: Path, checkpoint: Path, runs: int) -> list[Measurement]:
    """Time eager, dense and compiled with one thread each, in a process that has done nothing else."""
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as process:
        measurements: list[Measurement] = process.submit(time_calls, artifact, checkpoint, runs, threads=1).result()
    return measurements


def calibration_table(result: CalibrationResult) -> Table:
    """The plans that calibration judged, on the episodes that it did not learn from."""
    title = f"error of the actions on {result.calls['validation']} calls of the dense policy that were held out"
    table = Table(title=title)
    table.add_column("plan")
    for column in ("mean, px", "90th percentile, px", "cells reused", "FLOPs saved"):
        table.add_column(column, justify="right")
    for name, score in result.plans.items():
        table.add_row(
            f"{name} (default)" if name == result.default_plan else name,
            f"{score.error:.1f}",
            f"{score.error_p90:.1f}",
            f"{score.sparsity:.1%}",
            f"{score.flops_saved:.1%}",
        )
    return table


def final_table(speeds: Sequence[Measurement], evaluations: Sequence[Evaluation]) -> Table:
    """The three ways to run the policy, side by side: speed of one call, and score where it was evaluated."""
    eager = speeds[0]
    dense_score, compiled_score = evaluations
    table = Table(title="Push-T: diffusion transformer, 100 denoising steps")
    table.add_column("")
    for label in ("eager PyTorch", "dense onnxruntime", "compiled"):
        table.add_column(label, justify="right")
    table.add_row("ms a call, 1 thread", *(f"{m.median:.1f}" for m in speeds))
    table.add_row("calls a second", *(f"{1000 / m.median:.1f}" for m in speeds))
    table.add_row("times faster than eager", *(f"{eager.median / m.median:.1f}" for m in speeds))
    table.add_row("GFLOP a call", *(f"{m.flops / 1e9:.2f}" for m in speeds))
    table.add_row("cells reused", *(f"{m.sparsity:.1%}" for m in speeds))
    table.add_row("score, 95 % interval", "as dense", str(dense_score.score), str(compiled_score.score))
    table.add_row("success", "as dense", f"{dense_score.success.mean:.0%}", f"{compiled_score.success.mean:.0%}")
    return table


@click.command()
@click.option("--checkpoint", default=CHECKPOINT, show_default=True, type=click.Path(exists=True, path_type=Path))
@click.option("--directory", default=BUILD, show_default=True, type=click.Path(file_okay=False, path_type=Path))
@click.option("--record-episodes", default=16, show_default=True, type=click.IntRange(2))
@click.option("--calibration-minutes", default=5.0, show_default=True, type=click.FloatRange(min=0.1))
@click.option("--target-sparsity", default=0.95, show_default=True, type=click.FloatRange(0, 1, max_open=True))
@click.option("--episodes", default=12, show_default=True, type=click.IntRange(1), help="Of the evaluation.")
@first_seed_option
@click.option("--runs", default=10, show_default=True, type=click.IntRange(1), help="Timed calls of each.")
@click.option("--batch", default=16, show_default=True, type=click.IntRange(1), help="Episodes in lockstep.")
@threads_option
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
) -> None:
    """Compile the Push-T policy, calibrate it, and compare it with the original."""
    console = results_console()
    directory.mkdir(parents=True, exist_ok=True)
    artifact, calls = directory / "compiled", directory / "calls.npz"
    console.print(one_line(fingerprint()), highlight=False, soft_wrap=True)

    console.rule("1 of 5: convert")
    program = ttscompile.convert(checkpoint, artifact)
    console.print(
        f"{len(program.blocks)} residual blocks, {program.dense_flops / 1e9:.1f} GFLOP a dense call: {artifact}"
    )

    console.rule("2 of 5: record what the dense policy observes")
    console.print(f"{record_calls(artifact, calls, record_episodes, batch, threads)}: {calls}")

    console.rule("3 of 5: calibrate")
    result = ttscompile.calibrate(
        artifact, trajectories=[calls], target_sparsity=target_sparsity, seed=0, max_minutes=calibration_minutes
    )

    console.print(calibration_table(result))
    for name, reason in result.skipped.items():
        console.print(f"{name}: none, {reason}")

    console.rule("4 of 5: drive the robot, dense and compiled")
    seeds = range(first_seed, first_seed + episodes)
    evaluations = compare(artifact, seeds, batch, threads)
    console.print(evaluation_table(evaluations, seeds))

    console.rule("5 of 5: time one call")
    speeds = time_alone(artifact, checkpoint, runs)
    console.print(speed_table(speeds, threads=1))

    console.rule("result")
    console.print(final_table(speeds, evaluations))
    picture, animation = directory / "plan.png", directory / "episode.gif"
    kinds = [block.kind for block in program.blocks]
    plan = speeds[-1].plan
    if plan is not None:
        plot_plan(plan, kinds, picture)
        console.print(f"plan of one call: {picture}")
    first = [evaluation.rollout.episodes[0] for evaluation in evaluations]
    save_animation(animation, first, ["dense", f"compiled, {speeds[-1].sparsity:.0%} of the cells reused"])
    console.print(f"episode of seed {first_seed}, dense and compiled: {animation}")
    console.print(f"next: .venv/bin/ttscompile inspect {artifact}; docs/tutorial.md has the rest", soft_wrap=True)


if __name__ == "__main__":
    run(main)
