"""The rungs of reuse: what it changes in the actions, beside what other noise would change; and what plans save.

A cache that never engages gives perfect actions, and saves nothing: so neither is enough alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from ..artifact.ceiling import uncalibrated
from ..artifact.golden import Golden
from ..artifact.load import Artifact
from ..artifact.manifest import PlanRecord
from ..core.lattice import sparsity
from ..core.plan import DENSE, FULL, UNIFORM
from ..core.spec import Noise, PolicySpec
from ..measure.machine import busy
from ..measure.points import pairs, rooted
from ..measure.timer import Timer
from ..runtimes.policy import CompiledPolicy
from ..runtimes.random_calls import random_noise
from ..runtimes.report import CallReport
from ..trajectories.episodes import Episode
from .rung import FAILED, PASSED, SKIPPED, Rung, finite, judged

SPARSITY, UNIT, OF_NOISE = "sparsity error", "action units", "other noise"

AS_CALIBRATED, FEW_AS_CALIBRATED = 2.0, 3.0
"""How often the mean error that calibration measured on held-out calls a plan's may be; and with ``FEW`` calls or less,
which are of a few episodes, whose calls are alike."""

FEW = 32

ROUNDING, NEGLIGIBLE = 0.001, 0.05
"""Share of the yardstick below which an error, or a distance, is no worse than calibrated: other processors round
otherwise, and distances are estimates."""

Progress = Callable[[str], None]
"""Told what is being done."""

Errors = dict[str | None, list[float]]
"""By plan, for each call: mean absolute difference of the executed actions from the dense call's with the same noise,
in their units. None: of a dense call with other noise."""


def choose(episodes: Sequence[Episode], calls: int) -> list[Episode]:
    """Whole episodes, spread over the recordings, until they hold this many calls; at least one."""
    order = np.random.default_rng(0).permutation(len(episodes))
    chosen, total = list[int](), 0
    for number in order.tolist():
        if total >= calls:
            break
        chosen.append(number)
        total += episodes[number].calls
    return [episodes[number] for number in sorted(chosen)]


def check_episodes(
    artifact: Artifact, golden: Golden, policy: CompiledPolicy, episodes: Sequence[Episode], told: Progress
) -> Rung:
    """Every plan against the dense policy with the same noise, call by call through whole episodes.

    A plan of another sampler, or one that begins with the chunk before, answers the same noise with other actions; what
    is judged of it is how far its answers to two draws of noise are from two of the dense policy's, in units of what
    other noise changes (``measure.points``). Else:

    The mean error of the default plan has to keep within what two dense calls with different noise are apart, or within
    what calibration measured on held-out calls (90th percentile), whichever is more. It also has to keep within
    ``AS_CALIBRATED`` times the mean that calibration measured, where it did: a plan that is much worse than it was may
    still be within the noise of its policy. Without episodes the recorded observations are used, which are random: then
    nothing is judged.
    """
    manifest = artifact.manifest
    if manifest.plans.keys() <= {FULL}:
        return Rung(SPARSITY, SKIPPED, "the artifact is not calibrated: every call computes all cells")
    spec, draw = manifest.spec, np.random.default_rng(0)
    name = manifest.default_plan if manifest.default_plan in manifest.plans else next(iter(manifest.plans))
    errors: Errors = {each: [] for each in (*manifest.plans, None)}
    own = artifact.plans[name]
    shared = own.otherwise is None and manifest.sampler_of(own.loop).takes_noise_as(spec.sampler)
    unpaired = None if shared else Unpaired(name)
    for i, obs in enumerate([one.observations for one in episodes] or [golden.raw_observations(spec)]):
        rows = [{k: a[r : r + 1] for k, a in obs.items()} for r in range(len(next(iter(obs.values()))))]
        if episodes:
            told(f"episode {i + 1} of {len(episodes)}, {len(rows)} call{'s' * (len(rows) != 1)}")
        _run(policy, spec, rows, draw, errors, unpaired)
    calls, other_noise = len(errors[None]), float(np.mean(errors.pop(None)))
    figures = {
        name: {"error": finite(float(np.mean(e))), "error_p90": finite(float(np.quantile(e, 0.9)))}
        for name, e in errors.items()
    }
    error = float(np.mean(errors[name]))
    details = {"plan": name, "calls": calls, "episodes": len(episodes), "plans": figures, "other_noise": other_noise}
    others = ", ".join(f"{n!r} {np.mean(e):.3g}" for n, e in errors.items() if n != name)
    found = f"executed actions of plan {name!r} are {error:.3g} from the dense policy's with the same noise, in their"
    found += f" units{f' ({others})' * bool(others)}; two dense calls with different noise are {other_noise:.3g} apart"
    if not episodes:
        found += f". No trajectories were given: these are {calls} calls on random observations, and not judged"
        remedy = "Give recorded episodes with --trajectories to have this judged."
        return Rung(SPARSITY, SKIPPED, found, finite(error), None, UNIT, remedy, details=details)
    promised, promised_p90 = (_promised(manifest.calibration, name, key) for key in ("error", "error_p90"))
    noise, unit, least = other_noise, UNIT, ROUNDING * other_noise
    if unpaired is not None:
        error, noise, unit, least = unpaired.distance, 1.0, OF_NOISE, NEGLIGIBLE
        promised, promised_p90 = _promised(manifest.calibration, name, "distance", "interval"), None
        found += f". It is of another loop, in which the same noise means something else: by two draws {error:.3g} away"
    beyond = max(noise, promised_p90 or 0.0)
    factor, worse = allowed(promised, least, calls)
    reasons = list[str]()
    if not error <= beyond:
        reasons.append("more than other noise would change")
    if not error <= worse:
        before = f"more than {factor:g} times the {promised:.3g} that calibration measured on held-out calls"
        reasons.append(f"worse than calibrated, {before}")
    details |= {"promised": promised, "promised_p90": promised_p90, "reasons": reasons}
    made = f"{calls} call{'s' * (calls != 1)} of {len(episodes)} episode{'s' * (len(episodes) != 1)}"
    made += f"{f' (few: more than {FEW} say more)' * (calls <= FEW)}: {found}"
    if reasons:
        made += f". This is {'; and '.join(reasons)}"
    remedy = "These episodes are unlike those of the calibration, or the plan is too sparse: calibrate with such"
    remedy += " episodes, or with a lower --target-sparsity."
    return judged(SPARSITY, error, min(beyond, worse), unit, made, remedy, details=details)


class Unpaired:
    """What a plan and the dense policy answer to the same two draws of noise, over many calls."""

    def __init__(self, plan: str) -> None:
        self.plan = plan
        self._own, self._dense = list[npt.NDArray[np.float64]](), list[npt.NDArray[np.float64]]()

    def add(self, own: npt.NDArray[np.float64], dense: npt.NDArray[np.float64]) -> None:
        """The actions that were executed of one call, ``[2, ...]``: a draw each."""
        self._own.append(own.reshape(2, -1))
        self._dense.append(dense.reshape(2, -1))

    @property
    def distance(self) -> float:
        """Between the two, in units of what other noise changes."""
        # All calls at once: whether noise changes anything is asked of the policy, and not of a call at rest.
        h, apart = pairs(np.stack(self._own), np.stack(self._dense))
        return rooted(float(h.mean()), float(apart.mean()))


def _run(
    policy: CompiledPolicy,
    spec: PolicySpec,
    rows: Sequence[Mapping[str, npt.NDArray[Any]]],
    draw: np.random.Generator,
    errors: Errors,
    unpaired: Unpaired | None,
) -> None:
    noises, others = ([random_noise(spec, draw) for _ in rows] for _ in range(2))

    def actions(plan: str, with_noise: Sequence[Noise]) -> list[npt.NDArray[np.float64]]:
        policy.reset()
        made = (policy.predict_action(o, noise=n, plan=plan)["action"] for o, n in zip(rows, with_noise, strict=True))
        return [np.asarray(one, np.float64) for one in made]

    dense, other = actions(DENSE, noises), actions(DENSE, others)
    for name, found in errors.items():
        made = other if name is None else actions(name, noises)
        found += [float(np.abs(one - same).mean()) for one, same in zip(made, dense, strict=True)]
    if unpaired is not None:
        own = zip(actions(unpaired.plan, noises), actions(unpaired.plan, others), strict=True)
        for pair, both in zip(own, zip(dense, other, strict=True), strict=True):
            unpaired.add(*(np.stack(each) * spec.chunk.scale for each in (pair, both)))


def allowed(promised: float | None, least: float, calls: int) -> tuple[float, float]:
    """How often the error that calibration measured a plan's may be, and what that comes to.

    An error is recorded by whoever made the artifact: one that is better than what is measured is no excuse, however
    small both are.
    """
    factor = FEW_AS_CALIBRATED if calls <= FEW else AS_CALIBRATED
    return factor, float("inf") if promised is None else max(factor * promised, least)


def _promised(calibration: Mapping[str, Any] | None, name: str, *keys: str) -> float | None:
    """The most that calibration measured of a plan; of an interval its upper end, as an estimate may lie below 0."""
    plan = (calibration or {}).get("plans", {}).get(name, {})
    found = [plan[key] for key in keys if plan.get(key) is not None]
    return float(np.hstack(found).max()) if found else None


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
