"""``ttscompile bench``: what calls take, whether they keep up with a loop, and how far off their actions are."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from ttscompile.artifact.ceiling import BOUND, FARTHEST
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.manifest import abbreviated
from ttscompile.artifact.write import choose_default, require_unzipped
from ttscompile.calibration.proposer import near
from ttscompile.cli import options
from ttscompile.cli.contestants import Way, compare, contestants, draw_comparison, originals, print_comparison
from ttscompile.cli.output import print_identity, print_json, progress, results, say, table, warn_if_busy
from ttscompile.cli.sections import (
    Recordings,
    Section,
    SectionedCommand,
    Sources,
    require_recordings,
    trajectories_options,
)
from ttscompile.cli.summary import print_facts
from ttscompile.cli.types import PATH, PICTURE, RATE, TEXT
from ttscompile.core.plan import DENSE, UNIFORM
from ttscompile.core.spec import FP32
from ttscompile.errors import ArtifactError
from ttscompile.measure.machine import fingerprint, one_line, timed_on
from ttscompile.measure.points import best_plan
from ttscompile.measure.timer import Times
from ttscompile.measure.units import ms, number
from ttscompile.report.facts import scores
from ttscompile.report.timing import Contestant, Measurement, measure, timing_remarks, timing_table
from ttscompile.runtimes.executor import ExecutorSettings, Feasibility
from ttscompile.runtimes.executor.settings import Resolved, resolve
from ttscompile.runtimes.open import CPU

THIS = "this artifact"
MOST_CALLS = 10_000

NONE_KEEPS = "failed: no plan that is near enough keeps the deadline. The default stays {!r}; --plan names another one."

WORTH = 0.1
"""Share of a call's time that more threads have to save: they take their cores from the rest of the robot."""

SECTIONS = (
    Section("Beside the original network", ("checkpoint", "encoders"), ("checkpoint",)),
    Section("In a control loop", ("control_hz", *options.LOOP_OPTIONS), ("control_hz",)),
    Section("Action error, on recorded episodes", ("trajectories", "sources", "picture"), ("trajectories",)),
)


@click.command(cls=SectionedCommand, sections=SECTIONS)
@options.artifact_argument
@click.option(
    "--plan",
    "plans",
    type=TEXT,
    multiple=True,
    help="Look at this plan, beside the dense one; may be repeated. NAME@fp32, NAME@int8 and NAME@bf16 are plans in"
    " another precision. Without this option it is every plan.",
)
@click.option(
    "--with",
    "others",
    multiple=True,
    type=PATH,
    metavar="DIR...",
    help="Look at plans of these artifacts of the same checkpoint, too, which may have another sampler. Every word up"
    " to the next option is one.",
)
@options.names_option(
    "--runtime",
    options.OFFERED,
    default="onnxruntime",
    help="Execute the plans with onnxruntime, or with torch, which needs the extra 'compile'; or with each of them:"
    " onnxruntime,torch.",
)
@click.option("--device", type=TEXT, help="Have torch, and the original, compute on this device: cpu, cuda.")
@options.several_threads_option(
    "Compute with so many threads. Of several, as in 1,2,4, each plan is timed with each of these, and the rest"
    " is done with the first."
)
@options.count_option("--calls", "Count so many calls of each plan.", default=20, most=MOST_CALLS)
@options.json_option
@click.option(
    "--checkpoint",
    type=PATH,
    help="Time the checkpoint that DIRECTORY was made from, in PyTorch: in the loop that it was saved with, and in the"
    " artifact's if that is another.",
)
@options.encoders_option
@options.number_option(
    "--control-hz",
    RATE,
    "Say which plans keep up with a control loop of this rate in Hz. The exit status is 1 if none does.",
)
@options.loop_options
@trajectories_options(
    required=False, what="Hold the actions of the plans against those of the dense policy on these recorded episodes."
)
@click.option(
    "--choose",
    "chooses",
    is_flag=True,
    help="Make the plan the default that 'ttscompile build' would choose by these times, without calibrating again; or"
    " the best of those that --plan names. With --control-hz it is the nearest that keeps up. The exit status is 1 if"
    " none does.",
)
@click.option(
    "--plot",
    "picture",
    type=PICTURE,
    help="Draw distance against latency into this file (.png, .svg or .pdf), and the furthest calls beside it.",
)
@click.pass_context
def bench(
    context: click.Context,
    /,
    directory: Path,
    plans: tuple[str, ...],
    others: tuple[Path, ...],
    runtime: tuple[str, ...],
    device: str | None,
    threads: tuple[int, ...],
    calls: int,
    as_json: bool,
    checkpoint: Path | None,
    encoders: Path | None,
    control_hz: float | None,
    trajectories: Recordings,
    sources: Sources,
    chooses: bool,
    picture: Path | None,
    **settings: Any,
) -> None:
    """Time calls of the plans of the artifact DIRECTORY.

    The plans take turns on the same random observations. Every figure is of whole calls, for one robot at a time.
    Warm-up calls are not counted. With --control-hz and -t there is more to know about the same plans.
    """
    ways, artifacts = _ways(runtime, device, threads), _artifacts(directory, others)
    require_recordings(trajectories)
    artifact, console = artifacts[THIS], progress()
    named, plans = plans, _choices(directory, artifact, plans) if chooses else plans
    executor = ExecutorSettings(**settings)
    with console.status("loading"):
        entered = contestants(artifacts, plans, ways)
        # What does not fit is told before anything is measured.
        resolved = {} if control_hz is None else in_loop(entered, control_hz, executor)
        if checkpoint is not None:
            entered = [*originals(checkpoint, encoders, threads[0], artifact, device), *entered]
    default = artifact.manifest.default_plan
    warn_if_busy(console)
    if default == DENSE and artifact.manifest.steps > 1 and artifact.manifest.calibration is None:
        say(console, f"warning: {directory} is not calibrated: its default plan is the dense one.")
    seed = (artifact.manifest.calibration or {}).get("seed", 0)  # holds out the episodes that its calibration held out
    asked = {"observation": sources, "plans": plans, "calls": calls, "seed": int(seed), **vars(ways[0])}
    compared = compare(directory, artifacts, others, trajectories, **asked) if trajectories else None
    with console.status("timing") as status:
        measured = measure(entered, calls, 0, lambda done, of: status.update(f"timing: round {done} of {of}"))
    # The longest call has to fit.
    verdicts = {m.label: resolved[m.label].feasibility(max(m.times_ms) / 1e3) for m in measured if m.label in resolved}
    limit = 1e3 * max(min(one.max_latency for one in verdicts.values()), 0.0) if verdicts else None
    chosen = choose_again(directory, artifact, measured, limit, threads[0], bool(named)) if chooses else None
    by_threads = _by_threads(entered, measured, plans[0] if plans else default)
    identities = {path: artifacts[path.resolve().name].manifest.identity for path in others}
    if as_json:
        plans_in_loop = {label: one.to_json() for label, one in verdicts.items()}
        document = {
            "identity": artifact.manifest.identity,
            "machine": fingerprint(),
            "with": [{"path": str(path), "identity": identity} for path, identity in identities.items()],
            "runtime": runtime,
            "device": device or CPU,
            "calls": calls,
            "threads": list(by_threads),
            "best_threads": fewest_threads(by_threads),
            "contestants": [m.to_json() for m in measured],
            "loop": {"control_hz": control_hz, "plans": plans_in_loop} if verdicts else None,
            "comparison": None if compared is None else compared.to_json(),
            "chosen": chosen,
        }
        print_json(document)
    else:
        output = results()
        _print_times(measured, default, by_threads, output)
        print_verdicts(verdicts, control_hz, output)
        if compared is not None:
            print_comparison(compared, output)
        if chosen is not None:
            say(output, chosen)
        say(output, one_line(fingerprint()))
        print_identity(artifact.manifest.identity, output)
        say(output, *(f"{path}: identity {abbreviated(identity)}" for path, identity in identities.items()))
    drawn = [draw_comparison(compared, directory, picture)] if compared is not None and picture is not None else []
    failed = [NONE_KEEPS.format(default)] * (chooses and chosen is None)
    say(console, *drawn, *failed)
    if failed or (verdicts and chosen is None and not any(one.feasible for one in verdicts.values())):
        context.exit(1)


def _print_times(
    measured: Sequence[Measurement], default: str, by_threads: Mapping[int, float], output: Console
) -> None:
    print_facts(output, timing_table(measured, default, ("prologue", "frames", "pruner")))
    say(output, timing_remarks(measured))
    if len(by_threads) > 1:
        best = fewest_threads(by_threads)
        say(output, f"Load it with threads={best}: more of these save less than {WORTH:.0%} of a call.")


def fewest_threads(medians: Mapping[int, float]) -> int:
    """The smallest number of threads that no other one is faster than by more than ``WORTH``; ``medians`` by number."""
    bound = min(medians.values()) / (1 - WORTH)
    return min(number for number, median in medians.items() if median <= bound)


def _artifacts(directory: Path, others: Sequence[Path]) -> dict[str, Artifact]:
    found = {THIS: load_artifact(directory)}
    for other in others:
        if (name := other.resolve().name) in found:
            raise click.UsageError(f"two artifacts are called {name!r}: they could not be told apart. Rename one.")
        found[name] = load_artifact(other)
    return found


def _choices(directory: Path, artifact: Artifact, asked: tuple[str, ...]) -> tuple[str, ...]:
    """What is timed to choose among: what was asked for, if one of it may be the default, or all that may be it."""
    require_unzipped(directory)
    known = tuple(choosable(artifact))
    if asked and not set(asked) & set(known):
        raise click.UsageError(f"--choose: no --plan may be the default; expected one of {', '.join(known)}.")
    if not asked and not choosable(artifact, BOUND):
        told = f"no plan is surely within {BOUND:g} of the original. Evaluate one, and name it with --plan"
        raise click.UsageError(f"--choose: {told}: {', '.join(known)}.")
    return asked or known


def _ways(runtimes: Sequence[str], device: str | None, threads: Sequence[int]) -> list[Way]:
    """Each runtime with each number of threads; the device is torch's where it is one of the runtimes."""
    if not runtimes:
        raise click.UsageError("--runtime: nothing was given.")
    if len(threads) > 1 and "torch" in runtimes:
        raise click.UsageError("--runtime torch has one number of threads in a process: give --threads one number.")
    others = None if "torch" in runtimes else device
    return [Way(one, device if one == "torch" else others, number) for one in runtimes for number in threads]


def _by_threads(entered: Sequence[Contestant], measured: Sequence[Measurement], plan: str) -> dict[int, float]:
    """Median of this plan of the artifact, in ms, by its number of threads."""
    timed: dict[int, float] = {}
    for one, m in zip(entered, measured, strict=True):
        if one.plan == plan and one.policy is not None:
            timed.setdefault(one.threads, m.median_ms)
    return timed


def in_loop(entered: Sequence[Contestant], control_hz: float, settings: ExecutorSettings) -> dict[str, Resolved]:
    """The plans in a control loop, by label; a network alone drives nothing. Raises ExecutorError: one does not fit."""
    return {
        one.label: resolve(replace(settings, tiers=(one.plan,)), one.policy.info, control_hz)
        for one in entered
        if one.policy is not None
    }


def print_verdicts(verdicts: Mapping[str, Feasibility], control_hz: float | None, output: Console) -> None:
    """Whether plans keep up, by label, with the arithmetic; nothing if that was not asked."""
    if control_hz is None:
        return
    made = table(f"control loop of {control_hz:g} Hz", "longest ms", "may take ms", "up to Hz", "verdict")
    for label, one in verdicts.items():
        allowed, verdict = ms(max(1e3 * one.max_latency, 0), 4), "feasible" if one.feasible else "too slow"
        made.add_row(label, ms(1e3 * one.latency, 4), allowed, number(one.max_policy_hz), verdict)
    output.print(made)
    say(output, *(f"{label}: {one.explain()}" for label, one in verdicts.items()))
    if any(UNIFORM in label for label in verdicts):
        say(output, f"{UNIFORM} is for comparisons: evenly spaced steps, not calibrated. Not for a robot.")
    say(output, "The longest call has to fit. Hz: of the policy, with as many control ticks an action as here.")


IN_FP32 = f"@{FP32}"

JUDGED = "judged_in"
"""In the record of a calibration: by plan that is in fp32 here what it was judged in, as in ``NAME@int8+PART``."""


def choosable(artifact: Artifact, usual: float = FARTHEST) -> dict[str, float]:
    """How far plans are from the original that were judged to be within a bound, by name.

    The bound of a build (``--error``) takes the place of the usual ones. Plans of fewer bits are among them in fp32,
    too, in which they are no further away; and those that were made fp32 here, in what they were judged in. Raises
    ArtifactError: none is within the bound.
    """
    found, record = dict[str, float](), artifact.manifest.calibration or {}
    bound = record.get("budget", {}).get("max_distance", usual)
    for name, score in scores(record, ("distance", "interval")).items():
        within = name in artifact.plans and near(score["distance"], score["interval"], bound)
        if within and name not in (DENSE, UNIFORM):
            found[name] = score["distance"]
            if artifact.plans[name].precision and artifact.plans[name].tokens is None:
                found[name + IN_FP32] = score["distance"]
            elif (judged := record.get(JUDGED, {}).get(name)) is not None:
                found[f"{name}@{judged}"] = score["distance"]
    if usual == FARTHEST and not found:
        problem = f"{artifact.path}: there is nothing to choose among: no plan was judged to be within {bound:g}"
        raise ArtifactError(f"{problem}. Run 'ttscompile build', or 'ttscompile calibrate', first.")
    return found


def choose_again(
    directory: Path,
    artifact: Artifact,
    measured: Sequence[Measurement],
    deadline_ms: float | None,
    threads: int,
    asked: bool = False,
) -> str | None:
    """Make the plan the default that the rule of ``build`` chooses by these times, and keep them in the record.

    Args:
        measured: of plans that are ``choosable``, and of others, on this machine.
        deadline_ms: that the longest call may take; None for that of the build, if it had one.
        threads: that these calls had.
        asked: whether somebody named these plans, so that one may be the default that is not near for sure.

    Returns:
        What was chosen, for people; None where no plan keeps the deadline, and nothing was changed.
    """
    record, far, close = dict(artifact.manifest.calibration or {}), choosable(artifact), choosable(artifact, BOUND)
    deadline = record.get("budget", {}).get("latency_ms") if deadline_ms is None else deadline_ms
    times: dict[str, Times] = {}
    for one in measured:
        if one.plan in far:  # of another artifact, or with more threads, it is timed later
            times.setdefault(one.plan, Times(one.times_ms))
    chosen = best_plan({n: one for n, one in times.items() if asked or n in close}, far, deadline)
    if chosen is None:
        return None
    (name, _, wanted), before = chosen.partition("@"), artifact.manifest.default_plan
    told = ", ".join(f"{each} {ms(one.median)} ms" for each, one in times.items())
    record |= {"default_plan": name, "chosen_by": told, "timed_on": timed_on(threads)}
    precision: dict[str, str] | None = None
    if wanted:
        own, precision = artifact.plans[name].precision, dict(artifact.plan(chosen).precision)
        words = replace(artifact.plans[name], precision=precision).in_words()
        if own:  # so that another machine may have it back
            judged = "+".join((next(iter(own.values())), *own))
            record[JUDGED] = {**record.get(JUDGED, {}), name: judged}
        tried = record.get("frontier", ())
        record["frontier"] = [{**row, "told": words} if row["name"] == name else row for row in tried]
    choose_default(directory, name, record, precision, artifact)
    changed = "is" if name == before else f"was {before!r}, and is"
    in_ = f", in {wanted.partition('+')[0]}" if wanted else ""
    return f"The default {changed} {name!r}{in_}. {told}."
