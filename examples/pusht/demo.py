"""From a trained checkpoint to a compiled policy that is as good as the original: record, build, drive, time.

    python examples/pusht/demo.py

The policy pushes a T-shaped block onto its goal; LeRobot's own code trained it, by flow matching, as vision-language-
action models are. The demo records 16 episodes, has ``ttscompile build`` find the fastest plan, drives 2,400
paired episodes with it and with the original, and times it beside PyTorch. It ends with a verdict: equivalent to the
original within a margin, or not. If 2,400 episodes do not show that it is, the demo drives as many again, and if those
do not, ``safe`` as well. It takes 7 to 20 minutes on 2 cores where the first look settles it; everything it makes is in
``build/pusht/POLICY``.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.step_counts import SAFE
from ttscompile.cli.contestants import Way, contestants, originals
from ttscompile.cli.summary import print_frontier
from ttscompile.core.lattice import Source
from ttscompile.core.plan import DENSE, Plan
from ttscompile.core.spec import BF16, FP16, FP32, INT8
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.plots.figure import write_picture
from ttscompile.plots.maps import plot_plan
from ttscompile.report.timing import measure

sys.path.append(str(Path(__file__).resolve().parents[1] / "evaluation"))
from animate import save_animation
from environments.pusht import PushT
from episodes import Episodes
from equivalence import EQUIVALENT, SCORE_MARGIN, SUCCESS_MARGIN, WORSE, Verdict, joined
from evaluate import Evaluation, evaluate, evaluation_table, verdict_table, verdicts_of
from jobs import Processes, fill_cache
from record import save_trajectories
from rollout import run_episodes
from variants import first_seed_option, open_variant, results_console, run, threads_option

EXAMPLES = Path(__file__).resolve().parents[1]
BUILD = EXAMPLES.parent / "build" / "pusht"
POLICIES: Mapping[str, tuple[Path, str | None]] = {
    "flow": (EXAMPLES / "policies" / "flow" / "policy", "push the T onto its place"),
    "transformer": (EXAMPLES / "pusht" / "pusht_dpt_ema_fp16.ckpt", None),
    "unet": (EXAMPLES / "policies" / "unet" / "pusht_unet_ema_fp16.ckpt", None),
}
"""Checkpoints that push the T, and their instructions."""
ORIGINAL = "original"
LOOKS = 2
"""How often at most it is asked whether the default is equivalent, of more episodes each time."""
BITS = {INT8: 8, BF16: 16, FP16: 16}
"""Of a weight, by its precision."""


@dataclass(frozen=True)
class Step:
    """One way to make a call, on the way from PyTorch to the chosen plan.

    Attributes:
        what: it does, for people.
        ms: median of a call.
    """

    what: str
    ms: float


def progress_bar() -> Progress:
    """On standard error, gone when it is done."""
    return Progress(console=Console(stderr=True), transient=True)


def record_calls(artifact: Path, output: Path, episodes: int, batch: int, threads: int) -> str:
    """Drive Push-T with the original policy on seeds 0, 1, ... and write the observations.

    Returns:
        A line about it.
    """
    original = open_variant(f"{artifact}:{DENSE}", "onnxruntime", threads)
    with progress_bar() as progress:
        task = progress.add_task("recording episodes", total=episodes)
        rollout = run_episodes(PushT, original, range(episodes), batch, lambda n: progress.update(task, completed=n))
    save_trajectories(output, [episode.windows for episode in rollout.episodes])
    return f"{sum(episode.calls for episode in rollout.episodes)} calls in {episodes} episodes"


def drive(artifact: Path, plans: Sequence[str], seeds: Sequence[int], batch: int, jobs: int) -> list[Evaluation]:
    """Evaluate the original and plans on the same seeds, with the same initial noise.

    The original is run by onnxruntime, which gives the actions of the checkpoint's own code and takes less time.
    Episodes are kept beside the artifact, so that a second demo or ``evaluate.py`` need not run them again.
    """
    name, runtime, cache = "pusht", "onnxruntime", artifact.parent / "episodes"
    texts = [f"{artifact}:{plan}" for plan in (DENSE, *plans)]
    labels = dict(zip(texts, (ORIGINAL, *plans), strict=True))
    with progress_bar() as progress:
        tasks = {text: progress.add_task(f"driving: {label}", total=len(seeds)) for text, label in labels.items()}

        def finished(text: str, count: int) -> None:
            progress.update(tasks[text], completed=count)

        fill_cache(name, texts, seeds, batch, runtime, cache, Processes(jobs), finished)
    opened = [replace(open_variant(text, runtime, 1), label=label) for text, label in labels.items()]
    caches = [Episodes(cache, name, variant, runtime) for variant in opened]
    return evaluate(PushT, opened, seeds, batch, caches=caches)


def settle(
    plans: Sequence[str], episodes: int, driven: Callable[[Sequence[str], int], list[Evaluation]]
) -> tuple[list[Evaluation], list[tuple[Verdict, Verdict]]]:
    """Drive the robot until a plan is known to be equivalent to the original.

    The first plan is driven in more and more episodes, ``LOOKS`` times. If it is not known to be equivalent then, all
    plans are driven in as many. That is one look more, and all looks share the error.

    Args:
        plans: fastest first.
        episodes: of the first look, and of each further one as many more.
        driven: gives the evaluations of the original and of some plans, in so many episodes.

    Returns:
        The last evaluations, and what they say.
    """
    tries = [(plans[:1], look * episodes) for look in range(1, LOOKS + 1)]
    if len(plans) > 1:
        tries.append((plans, LOOKS * episodes))
    for names, count in tries:
        evaluations = driven(names, count)
        verdicts = verdicts_of(evaluations, (SCORE_MARGIN, SUCCESS_MARGIN), len(tries))
        if EQUIVALENT in map(joined, verdicts):
            break
    return evaluations, verdicts


def steps_to(name: str, plan: Plan) -> dict[str, str]:
    """The steps from the compiled original to a plan: what each does, for people, and the plan that is timed for it.

    Args:
        name: of the plan in its artifact.
        plan: what it says.
    """
    steps = {"compiled, everything computed": DENSE}
    if name == DENSE:
        return steps
    if plan.cells is None:
        computed = "the cells computed that the pruner chooses"
    else:
        computed = f"{int((np.asarray(plan.cells) == Source.COMPUTE).all(axis=1).sum())} steps computed"
    if not plan.precision:
        return {**steps, computed: name}
    parts = dict[int, list[str]]()
    for part, precision in plan.precision.items():
        parts.setdefault(BITS[precision], []).append(part)
    fewer = "; ".join(f"{bits}-bit weights in {', '.join(named)}" for bits, named in parts.items())
    return {**steps, computed: f"{name}@{FP32}", fewer: name}


def time_steps(checkpoint: Path, artifact: Path, plan: str, calls: int) -> list[Step]:
    """What each step from PyTorch to a plan makes of a call, one thread each: compiled, sparse, in fewer bits."""
    opened = load_artifact(artifact)
    steps = steps_to(plan, opened.plan(plan))
    first, *_ = originals(checkpoint, None, 1, opened)
    measured = measure([first, *contestants({"": opened}, list(steps.values()), [Way()])], calls, seed=0)
    told = ["the original, in PyTorch", *steps]
    return [Step(what, each.median_ms) for what, each in zip(told, measured, strict=True)]


def time_alone(checkpoint: Path, artifact: Path, plan: str, calls: int) -> list[Step]:
    """``time_steps``, in a process that has done nothing else."""
    said: Any = {"initializer": warnings.simplefilter, "initargs": ("ignore", UserWarning)}  # by this process
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn"), **said) as process:
        return process.submit(time_steps, checkpoint, artifact, plan, calls).result()


def speed_table(steps: Sequence[Step]) -> Table:
    """Each step with its own factor, and all together."""
    table = Table(title="one call, one thread", caption="medians of calls that took turns")
    table.add_column("")
    for column in ("ms a call", "faster than the row above", "than the original"):
        table.add_column(column, justify="right")
    for before, step in zip([None, *steps], steps, strict=False):
        factors = ("", "") if before is None else (f"{before.ms / step.ms:.1f} x", f"{steps[0].ms / step.ms:.1f} x")
        table.add_row(step.what, f"{step.ms:.2f}", *factors)
    return table


def conclusion(plan: str, steps: Sequence[Step], pair: tuple[Verdict, Verdict]) -> str:
    """What was found, in the order in which somebody would ask."""
    score, success = pair
    faster = f"Plan '{plan}' takes {steps[-1].ms:.1f} ms a call, and is {steps[0].ms / steps[-1].ms:.0f} times faster"
    within = f"{score.margin:g} of the score and {success.margin:.0%} of success"
    word = joined(pair)
    if word == WORSE:
        return f"{faster}. It is worse than the original."
    if word == EQUIVALENT:
        return f"{faster}. It is equivalent to the original: less than {within} is lost, in {score.episodes} episodes."
    enough = max(each.enough or 0 for each in pair)
    return f"{faster}. {score.episodes} episodes are too few to say whether {within} is lost; {enough:,} may do."


def best_of(verdicts: Sequence[tuple[Verdict, Verdict]]) -> int:
    """The first plan that is equivalent to the original, else the last: plans come fastest first."""
    words = [joined(pair) for pair in verdicts]
    return words.index(EQUIVALENT) if EQUIVALENT in words else len(words) - 1


@click.command()
@click.option("--policy", default="flow", show_default=True, type=click.Choice(list(POLICIES)))
@click.option("--directory", default=BUILD, show_default=True, type=click.Path(file_okay=False, path_type=Path))
@click.option("--record-episodes", default=16, show_default=True, type=click.IntRange(2))
@click.option("--minutes", default=5.0, show_default=True, type=click.FloatRange(min=0.1), help="Of the build.")
@click.option(
    "--episodes",
    default=2400,
    show_default=True,
    type=click.IntRange(2),
    help="Of the evaluation; twice as many if they do not settle it.",
)
@first_seed_option
@click.option("--runs", default=30, show_default=True, type=click.IntRange(1), help="Timed calls of each.")
@click.option("--batch", default=25, show_default=True, type=click.IntRange(1), help="Episodes in lockstep.")
@threads_option
@click.option("--jobs", type=click.IntRange(1), help="Processes that evaluate; one a core if you say nothing.")
def main(
    policy: str,
    directory: Path,
    record_episodes: int,
    minutes: float,
    episodes: int,
    first_seed: int,
    runs: int,
    batch: int,
    threads: int,
    jobs: int | None,
) -> None:
    """Build a policy that pushes the T, and say whether it is as good as the original."""
    console = results_console()
    checkpoint, task = POLICIES[policy]
    directory = directory / policy
    directory.mkdir(parents=True, exist_ok=True)
    artifact, calls = directory / "compiled", directory / "calls.npz"
    machine = fingerprint()
    console.print(one_line(machine), highlight=False, soft_wrap=True)

    console.rule("1 of 4: record what the policy observes")
    ttscompile.convert(checkpoint, directory / "original", task=task)
    console.print(f"{record_calls(directory / 'original', calls, record_episodes, batch, threads)}: {calls}")

    console.rule("2 of 4: build: what can be left out of a call?")
    ttscompile.build(checkpoint, artifact, [calls], max_minutes=minutes, task=task)
    built = load_artifact(artifact)
    print_frontier(built, artifact, console, threads=1)

    console.rule("3 of 4: drive the robot with the original and with the compiled policy")
    plans = [built.manifest.default_plan]
    if SAFE in built.plans:
        plans.append(SAFE)

    def driven(names: Sequence[str], count: int) -> list[Evaluation]:
        return drive(artifact, names, range(first_seed, first_seed + count), batch, jobs or machine["cores"])

    evaluations, verdicts = settle(plans, episodes, driven)
    seeds = [episode.seed for episode in evaluations[0].rollout.episodes]
    console.print(evaluation_table(PushT.title, evaluations, seeds))
    console.print(verdict_table(evaluations, verdicts))

    console.rule("4 of 4: time one call")
    best = best_of(verdicts)
    plan = plans[best]
    steps = time_alone(checkpoint, artifact, plan, runs)
    console.print(speed_table(steps))

    console.rule("result")
    console.print(conclusion(plan, steps, verdicts[best]), highlight=False)
    picture, animation = directory / "plan.png", directory / "episode.gif"
    cells = built.plan(plan).cells
    if cells is not None:
        write_picture(plot_plan(cells, [block.kind for block in built.manifest.blocks]), picture)
        console.print(f"which blocks one call computes: {picture}")
    pair = [evaluations[0].rollout.episodes[0], evaluations[1 + best].rollout.episodes[0]]
    save_animation(animation, PushT, pair, [ORIGINAL, plan])
    console.print(f"the episode of seed {first_seed}, original and compiled: {animation}")
    console.print(f"everything on one page: .venv/bin/ttscompile inspect {artifact} -o page.html", soft_wrap=True)
    console.print("what to do with a policy of your own: docs/tutorial.md", soft_wrap=True)


if __name__ == "__main__":
    run(main)
