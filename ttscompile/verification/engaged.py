"""The last rung: plans do what they are for. A cache that never engages gives perfect actions, and saves nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from time import perf_counter

from ..artifact.ceiling import uncalibrated
from ..artifact.golden import Golden
from ..artifact.load import Artifact
from ..artifact.manifest import PlanRecord
from ..core.lattice import sparsity
from ..core.plan import DENSE, FULL, UNIFORM
from ..core.spec import Noise
from ..measure.timer import Timer
from ..runtimes.policy import CompiledPolicy
from ..runtimes.report import CallReport
from .rung import FAILED, PASSED, SKIPPED, Rung

ENGAGED = "engaged"

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
    """Planned against executed cells, FLOPs and time of every plan; one that saves nothing fails."""
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
    if faults:
        remedy = "The plan is inert on this machine: calibrate again, and look at 'ttscompile inspect --plot'."
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
    noise = Noise(golden.initial[:1], None if golden.draws is None else golden.draws[:, :1].copy())
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
            f"reuses {shown} and saves no time: {one.ms:.4g} ms a call, dense {one.dense_ms:.4g} ms, which is"
            f" {one.time_saved:.1%} saved and has to be {LEAST_SAVED:.0%}"
        )
    return ""
