"""The rungs of reuse: how far plans are from the original, in units of what other noise changes; and what they save.

A cache that never engages gives perfect actions, and saves nothing: so neither is enough alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from ..artifact.ceiling import uncalibrated
from ..artifact.golden import Golden
from ..artifact.load import Artifact
from ..artifact.manifest import PlanRecord
from ..core.coercion import Arrays
from ..core.lattice import sparsity
from ..core.plan import DENSE, FULL, UNIFORM
from ..core.spec import Noise
from ..measure.machine import busy
from ..measure.points import Gaps
from ..measure.timer import Timer
from ..runtimes.policy import CompiledPolicy
from ..runtimes.random_calls import random_noise
from ..runtimes.report import CallReport
from ..trajectories.episodes import Episode
from .rung import FAILED, PASSED, SKIPPED, Rung, finite

DISTANCE, UNIT = "distance", "other noise"

AS_CALIBRATED = 2.0
"""How often the distance that calibration measured on held-out calls a plan's may be."""

DRAWS = 2
"""Of noise for each call. The judge of calibration, which is not in a hurry, asks more often."""

NEGLIGIBLE = 0.05
"""A distance that is no worse than calibrated, whatever calibration measured: it is an estimate, and other processors
round otherwise."""

Progress = Callable[[str], None]
"""Told what is being done."""


def choose(episodes: Sequence[Episode], calls: int) -> list[Episode]:
    """Whole episodes, spread over the recordings, until they hold this many calls; at least one."""
    order = np.random.default_rng(0).permutation(len(episodes))
    together = np.cumsum([episodes[number].calls for number in order])
    enough = order[: np.searchsorted(together, calls) + 1]
    return [episodes[number] for number in sorted(enough.tolist())]


def check_episodes(artifact: Artifact, policy: CompiledPolicy, episodes: Sequence[Episode], told: Progress) -> Rung:
    """How far every plan is from the original, by calls through whole episodes; the default's distance is judged.

    It is the distance of calibration's judge (``measure.points``), of ``DRAWS`` answers to each call and without torch.
    The rung fails where it is too large with 95 % confidence. The golden record says nothing of it: its observations
    are random.
    """
    manifest = artifact.manifest
    if manifest.plans.keys() <= {FULL}:
        return Rung(DISTANCE, SKIPPED, "the artifact is not calibrated: every call computes all cells")
    if not episodes:
        remedy = "Give recorded episodes with --trajectories to have this judged."
        return Rung(DISTANCE, SKIPPED, "there are no recorded episodes to measure it on", remedy=remedy)
    spec, draw = manifest.spec, np.random.default_rng(0)
    name = manifest.default_plan if manifest.default_plan in manifest.plans else next(iter(manifest.plans))

    def executed(plan: str, rows: Sequence[Arrays], noises: Sequence[Noise]) -> Any:
        """What a plan answers to the calls of an episode, normalised, ``[R, A]``."""
        policy.reset()
        made = [policy.predict_action(o, noise=n, plan=plan)["action"] for o, n in zip(rows, noises, strict=True)]
        return (np.concatenate(made) * spec.chunk.scale).astype(np.float64).reshape(len(rows), -1)

    answers: dict[str, list[Any]] = {each: [] for each in (DENSE, *manifest.plans)}  # by episode [R, DRAWS, A]
    for i, episode in enumerate(episodes):
        rows = [{k: a[r : r + 1] for k, a in episode.observations.items()} for r in range(episode.calls)]
        told(f"episode {i + 1} of {len(episodes)}, {len(rows)} call{'s' * (len(rows) != 1)}")
        noises = [[random_noise(spec, draw) for _ in rows] for _ in range(DRAWS)]
        for plan, made in answers.items():
            made.append(np.stack([executed(plan, rows, one) for one in noises], 1))
    original, numbers = answers.pop(DENSE), np.repeat(np.arange(len(episodes)), [*map(len, answers[name])])
    # All calls at once: whether noise changes anything is asked of the policy, and not of a call at rest.
    gaps = {n: Gaps.of(np.concatenate(made), np.concatenate(original), numbers) for n, made in answers.items()}
    calls, found, (low, high) = len(numbers), gaps[name].distance, gaps[name].interval
    details = {"plan": name, "calls": calls, "episodes": len(episodes)}
    details["plans"] = {n: {"distance": finite(one.distance), "interval": one.interval} for n, one in gaps.items()}
    others = ", ".join(f"{n!r} {one.distance:.3f}" for n, one in gaps.items() if n != name)
    shown = f"plan {name!r} is {found:.3f} from the original, and with 95 % confidence {low:.3f} to {high:.3f}"
    shown += f"{f' ({others})' * bool(others)}, in units of what other noise changes"
    most = bounds((manifest.calibration or {}).get("plans", {}).get(name, {}))
    details["reasons"] = reasons = [why for why, bound in most.items() if not low <= bound]
    shown = f"{calls} call{'s' * (calls != 1)} of {len(episodes)} episode{'s' * (len(episodes) != 1)}: {shown}"
    if reasons:
        shown += f". This is surely {'; and '.join(reasons)}"
    elif found > min(most.values()):
        shown += f". {min(most.values()):.3g} is allowed, which so few calls do not tell from that"
    remedy = "These episodes are unlike those of the calibration, or the plan is too sparse: calibrate with such"
    remedy += " episodes, or with a lower --target-sparsity."
    status, remedy = (FAILED, remedy) if reasons else (PASSED, "")
    return Rung(DISTANCE, status, shown, finite(found), min(most.values()), UNIT, remedy, details=details)


def bounds(score: Mapping[str, Any]) -> dict[str, float]:
    """The largest distances that a plan may have, by what one is called that is larger, given what calibration found.

    That is recorded by whoever made the artifact: a score that is better than what is measured is no excuse, unless
    both are ``NEGLIGIBLE``. Its estimate may lie below 0, and promises no more than its interval.
    """
    known = score.get("distance")
    beyond = {"more than other noise would change": max(1.0, AS_CALIBRATED * (known or 0.0))}
    if known is None:
        return beyond
    most = max((known, *score.get("interval", ())))
    before = f"more than {AS_CALIBRATED:g} times the {most:.3g} that calibration measured on held-out calls"
    return {**beyond, f"worse than calibrated, {before}": max(AS_CALIBRATED * most, NEGLIGIBLE)}


ENGAGED, NO_TIME = "engaged", "saves no time"

FEWEST_ROUNDS, MOST_ROUNDS = 3, 15
"""Rounds in which each plan, and a dense call, is timed once. How many there are is settled before the first of them:
rounds that went on until a plan was once the faster would let one pass that is as slow as a dense call."""

PATIENCE = 10.0
"""Seconds that they may take together, unless so few calls take longer."""

LEAST_SAVED = 0.05
"""Share of the time of a dense call that a plan has to save: less is what two medians of the same calls may differ
by."""

POOR = 0.5
"""Share of what its FLOPs promise below which the time that a plan saves is remarked upon."""

LEGALISED = 0.25
"""Share of the reused cells of a second call that may have had to take another source than planned."""

SHORT = {"schedule": 0.01, "pruner": 0.1}
"""How far the share of reused cells may stay behind what the manifest says, by kind of plan: that of a pruner depends
on the observation."""


@dataclass(frozen=True)
class Engagement:
    """What one plan saved, on one stream.

    Attributes:
        planned: share of cells to reuse as the manifest has it; None if it was not measured.
        executed: share that was reused in the second call of an episode.
        legalised: cells of that call that were computed, or reused otherwise, because their source was empty.
        flops_saved: share of the FLOPs of a dense call of the artifact.
        ms: median time of a call.
        dense_ms: median time of a dense one, taken in turn.
        time_saved: share, of these medians: slower calls beside other work hit few rounds, or plans and dense calls
            alike.
    """

    planned: float | None
    executed: float
    legalised: int
    flops_saved: float
    ms: float
    dense_ms: float
    time_saved: float


def check_engaged(
    artifact: Artifact, golden: Golden, policy: CompiledPolicy, clock: Callable[[], float] = perf_counter
) -> Rung:
    """Planned against executed cells, FLOPs and time of every plan; one that saves nothing fails.

    Where time alone is at fault, and other programs keep the machine busy, it is skipped.
    """
    manifest = artifact.manifest
    if manifest.plans.keys() <= {FULL} or manifest.steps == 1:
        return Rung(ENGAGED, SKIPPED, uncalibrated(manifest))
    found = _measure(artifact, golden, policy, clock)
    details = {name: asdict(one) for name, one in found.items()}
    judged = {
        name: _fault(plan := manifest.plans[name], one, manifest.steps_of(plan.loop) * len(manifest.blocks))
        for name, one in found.items()
    }
    if manifest.default_plan == UNIFORM:
        judged[UNIFORM] = "is the default, and is the baseline of comparisons: evenly spaced steps, not calibrated"
    faults = [f"plan {name!r} {fault}" for name, fault in judged.items() if fault]
    name = manifest.default_plan if manifest.default_plan in found else next(iter(found))
    figure = (found[name].executed, None, "of the cells")
    if faults and all(NO_TIME in fault for fault in faults) and (warning := busy()) is not None:
        told, _, remedy = warning.rpartition(". ")
        return Rung(ENGAGED, SKIPPED, f"{'; '.join(faults)}; but {told}", *figure, remedy, details=details)
    if faults:
        remedy = "The plan is inert on this machine: calibrate again, and look at 'ttscompile inspect DIR -o plan.png'."
        return Rung(ENGAGED, FAILED, "; ".join(faults), *figure, remedy, details=details)
    shown = []
    for n, one in found.items():
        less = ", less than half of what its FLOPs promise" if one.time_saved < POOR * one.flops_saved else ""
        shown.append(
            f"{n!r} reuses {one.executed:.1%} of the cells, saves {one.flops_saved:.1%} of the FLOPs and"
            f" {one.time_saved:.0%} of the time ({one.ms:.4g} ms for {one.dense_ms:.4g}{less})"
        )
    return Rung(ENGAGED, PASSED, "; ".join(shown), *figure, details=details)


def _measure(
    artifact: Artifact, golden: Golden, policy: CompiledPolicy, clock: Callable[[], float]
) -> dict[str, Engagement]:
    manifest = artifact.manifest
    obs = {key: value[:1] for key, value in golden.raw_observations(manifest.spec).items()}
    noise = random_noise(manifest.spec, np.random.default_rng(0))  # for any loop; the record's is for the original's
    names = (DENSE, *manifest.plans)
    reports, timer = dict[str, CallReport](), Timer(len(names), warm_up=1, clock=clock)

    def call_all() -> None:
        """Time a call of each plan in the middle of an episode."""
        for i in timer.round():
            name = names[i]
            call = partial(policy.predict_action, obs, noise=noise, plan=name)
            policy.reset()
            if name != DENSE:
                call()  # what an episode's first call cannot read
                policy.forget_frames()  # and what a dense one computes
            timer.time(i, call)
            assert policy.last_report is not None
            reports[name] = policy.last_report

    begun = clock()
    call_all()  # warms up, and tells how long a round takes
    rounds = int(PATIENCE / max(clock() - begun, 1e-9))
    for _ in range(min(max(rounds, FEWEST_ROUNDS), MOST_ROUNDS)):
        call_all()
    medians = {name: times.median for name, times in zip(names, timer.times, strict=True)}
    return {
        name: Engagement(
            planned=plan.sparsity,
            executed=sparsity(reports[name].plan),
            legalised=reports[name].legalised[0],
            flops_saved=1 - reports[name].flops[0] / reports[DENSE].flops[0],
            ms=medians[name],
            dense_ms=medians[DENSE],
            time_saved=1 - medians[name] / medians[DENSE],
        )
        for name, plan in manifest.plans.items()
        if name != FULL
    }


def _fault(plan: PlanRecord, one: Engagement, cells: int) -> str:
    """Why a plan is inert; empty if it is not."""
    shown = f"{one.executed:.2%} of the cells"
    if plan.kind == "all":
        alike = one.flops_saved <= 0 and not plan.precision and plan.tokens is None
        return "computes every cell: it is dense in disguise" if alike else ""
    if one.executed <= 0:
        return "computes every cell: it is dense in disguise"
    if one.planned is not None and one.executed < one.planned - SHORT[plan.kind]:
        return f"was to reuse {one.planned:.2%} of the cells and reuses {shown}, {one.legalised} being legalised"
    if one.legalised > LEGALISED * one.executed * cells:
        return f"has to be legalised in {one.legalised} cells of a second call: it reads what is never computed"
    if one.flops_saved <= 0:
        return f"reuses {shown} and saves no FLOPs"
    if not one.time_saved >= LEAST_SAVED:
        return (
            f"reuses {shown} and {NO_TIME}: {one.ms:.4g} ms a call, dense {one.dense_ms:.4g} ms, which is"
            f" {one.time_saved:.1%} saved and has to be {LEAST_SAVED:.0%}"
        )
    return ""
