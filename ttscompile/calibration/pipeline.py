"""Calibration, as one straight line: trials -> what each proposer proposes -> the judge -> artifact; and its result."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..artifact.ceiling import FARTHEST, usual_sparsity
from ..artifact.files import locked
from ..artifact.load import Artifact, load_artifact
from ..artifact.view import view_of
from ..artifact.write import update_plans
from ..core.coercion import integer
from ..core.plan import DENSE, ORIGINAL, SCHEDULE
from ..errors import CalibrationError, CalibrationFailedError
from ..measure.machine import timed_on
from ..pool import opened_pool
from ..runtimes.torch.devices import device_of, exact_arithmetic
from ..trajectories import recorded_rate
from ..verification.record_golden import record_plans
from .arguments import calls_to_learn_from, require_directory, require_limits, require_no_cells, require_one_place
from .budget import DISTANCE, ERROR, LATENCY, goal_of
from .calls import FRACTION, digest_of, load_episodes
from .choose import Frontier, choose, seconds_to_judge_others, seconds_to_time
from .clock import Clock
from .judge import Score, other_noise, seconds_to_judge
from .kept import Kept
from .progress import Bar
from .proposer import Proposer, Request, Row
from .proposers import LOOPS, SCHEDULES, rows_of
from .recordings import require_two_calls, warn_of_recordings
from .schedule import FINISHED, TIME_LIMIT, Schedule
from .state import StateFile
from .step_counts import FAST, SAFE
from .trials import CONFIRMING, LEARNED, Trials, base_of


@dataclass(frozen=True)
class CalibrationResult:
    """The outcome of a calibration.

    Attributes:
        learned: names of the proposers that took part.
        seed: the seed of everything random.
        target_sparsity: what was asked for, or what the budget comes to.
        default_plan: the plan that the artifact now uses; a key of ``plans``.
        plans: every plan that was kept, by name; ``uniform`` is the baseline that computes as much.
        episodes: numbers of the episodes in the order of the files, learned from and judged on.
        calls: how many calls of these were used; of those that are judged on every one with several draws of noise.
        intervals: how many intervals the search took.
        stopped: why it ended: ``finished`` or ``time limit``.
        seconds: of work, the parts before an interruption included.
        other_noise: mean absolute difference of the executed actions of two dense calls on one observation with
            different noise, in the units of the actions; None if it was not measured.
        policy_hz: rate of the frames and actions that the policy was trained with; None if nobody said it.
        budget: what was asked for, the cells that it comes to, and what was measured for it; JSON.
        skipped: why there is no plan of a name that there might be.
        told: by proposer, what became of it.
        held_out: digest of the episodes of the validation, which tells them from others.
        frontier: where the default was chosen among many plans, all of them, fastest first; JSON.
        timed_on: where these were timed (``measure.machine``).
    """

    learned: tuple[str, ...]
    seed: int
    target_sparsity: float
    default_plan: str
    plans: Mapping[str, Score]
    episodes: Mapping[str, tuple[int, ...]]
    calls: Mapping[str, int]
    intervals: int
    stopped: str
    seconds: float
    other_noise: float | None = None
    policy_hz: float | None = None
    budget: Mapping[str, Any] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)
    told: Mapping[str, str] = field(default_factory=dict)
    held_out: str = ""
    frontier: tuple[Mapping[str, Any], ...] = ()
    timed_on: str | None = None

    @property
    def doubtful(self) -> bool:
        """Whether scores may fall, so far from the original is the default plan, and nobody said how far it may be."""
        return not {ERROR, DISTANCE} & self.budget.keys() and self.plans[self.default_plan].distance > FARTHEST

    @property
    def sparsity(self) -> float:
        """Share of the cells that the default plan reuses."""
        return self.plans[self.default_plan].sparsity

    @property
    def flops_sparsity(self) -> float:
        """The same share with each cell weighed by its FLOPs."""
        return self.plans[self.default_plan].flops_sparsity

    def record(self) -> dict[str, Any]:
        """As JSON, for the artifact. Without the time it took: the same calibration gives the same bytes."""
        left_out = ("seconds",) if self.frontier else ("seconds", "frontier")
        record = {name: one for name, one in asdict(self).items() if one is not None and name not in left_out}
        return record | {"plans": {name: score.record() for name, score in self.plans.items()}}


def calibrate(
    path: str | os.PathLike[str],
    trajectories: Sequence[str | os.PathLike[str]],
    target_sparsity: float | None = None,
    seed: int = 0,
    resume: bool = False,
    *,
    learn: Sequence[str] = (SCHEDULE,),
    target_flops: float | None = None,
    latency_ms: float | None = None,
    max_action_error: float | None = None,
    max_distance: float | None = None,
    policy_hz: float | None = None,
    threads: int = 1,
    max_minutes: float = 15.0,
    validation_fraction: float = FRACTION,
    observation: Mapping[str, Sequence[str]] | None = None,
    max_intervals: int | None = None,
    correct: bool = False,
    rank: int = 16,
    updates: int = 600,
    device: str | None = None,
    progress: bool = True,
    ray: str | None = None,
) -> CalibrationResult:
    """Learn plans for an artifact from a few recorded episodes, and write them into it.

    What learns proposes plans, one after the other, each made from the best so far. They are judged on episodes that
    nothing was learned from: how far is what they answer from what the original answers to the same observation. Every
    few seconds the state is saved in the artifact's directory: whatever stops the process, a call with ``resume`` goes
    on from there, and ends where it would have ended. The same arguments give the same bytes, unless the time limit
    cuts something short, or the budget is a latency, which is measured.

    At most one budget: ``target_sparsity``, ``target_flops``, ``latency_ms`` or ``max_action_error``. Beside the plan
    that keeps it, ``schedule``, the artifact gets ``uniform``, the baseline. A proposer that fits corrections adds
    ``safe``, which computes twice as many cells, and ``fast``, which computes half as many. A calibration that learns a
    schedule replaces all plans but ``dense`` and ``full``, one that learns loops all but ``dense``; another one adds to
    them.

    Args:
        path: the artifact's directory.
        trajectories: recordings: ``.npz``, zarr, HDF5 or LeRobot data sets, see ``ttscompile.trajectories``.
        target_sparsity: share of the cells to reuse; if no budget is given, 0.95, or what leaves five whole steps.
        seed: the seed of the split, the noise and the search.
        resume: go on where a calibration with the same arguments was interrupted, with the same calls whatever
            ``max_minutes`` is now; begins anew if none was.
        learn: what is learned, names of ``ttscompile.calibration.proposers.PROPOSERS``, in their order there; of what
            makes a schedule, and of loops, one.
        target_flops: share of the FLOPs of a dense call to save, prologue and pruner counted.
        latency_ms: of a call with onnxruntime on this machine. Measured once, for as many whole steps as fit. Where
            loops are learned the nearest plan is taken of whose calls 99 of 100 keep it.
        max_action_error: mean absolute error of the executed actions on held-out episodes, in their units; the plan is
            the sparsest that was found below it. Only with a proposer that fits corrections.
        max_distance: by how much further from the original a plan may be that costs less than the one it was made from;
            None for what its proposer allows. Where loops are learned: the distance from the original that the
            default may have, see ``proposer.near``.
        policy_hz: rate in Hz of the frames and actions that the policy was trained with, which an executor plays its
            actions at; None for what the recordings say, or the artifact.
        threads: how many threads the calls have that are timed for ``latency_ms``.
        max_minutes: where loops are learned, by the clock. Else of work: those in which all of torch's threads compute,
            so that a busy machine takes up to twice as long by the clock. The best plan so far is taken in time to be
            finished by then, as far as what was done before lets it be known; what has to be done at least is done.
            Also decides how many calls are used.
        validation_fraction: of the episodes.
        observation: by key, the arrays of a recording that it is made of, where they are called otherwise; of ``task``
            the path of the tokenizer that makes recorded instructions tokens.
        correct: fit a correction of the sampler to the schedule of a proposer that fits none itself, and keep it if it
            is better on calls that it was not fitted on.
        rank: of the low-rank update to each weight matrix, where weights are learned.
        updates: of the weights.
        device: where the calls compute, as torch calls it, ``cuda``; None for the CPU. The results differ from those of
            the CPU by rounding. ``latency_ms`` is of onnxruntime, on the CPU.
        max_intervals: an end that does not depend on the machine's speed; None for the search's own.
        progress: show a bar on standard error.
        ray: address of a Ray cluster that answers dense calls and compares candidates, or ``local`` for one of this
            machine's cores; the outcome is the same. All its machines see the artifact under the same path. None
            works in this process.

    Raises:
        CalibrationFailedError: nothing that was proposed was kept: the budget was not, or nothing is better than what
            there was. The artifact is as it was.
        CalibrationError: the arguments cannot be satisfied, or there is nothing to resume with these.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: no artifact, one that another process is changing, or it cannot be written.
        RuntimeUnavailableError: torch does not have the device.
        ClusterError: the cluster cannot be reached, or is gone; what was done before can be resumed.
    """
    # Where others work this process waits; and for a build somebody does.
    wall = ray is not None or device not in (None, "cpu") or LOOPS in learn
    begun = Clock(wall=wall)
    seed = integer(seed, "seed", CalibrationError)
    rank, updates = integer(rank, "rank", CalibrationError, 1), integer(updates, "updates", CalibrationError, 1)
    if max_intervals is not None:
        max_intervals = integer(max_intervals, "max_intervals", CalibrationError, 1)
    require_limits(validation_fraction, max_minutes, max_distance, policy_hz)
    require_one_place(device, ray)
    place = None if device is None else device_of(device)
    asked = (target_sparsity, target_flops, latency_ms, max_action_error, threads)
    goal_of(*asked)  # what cannot be is refused before anything is read
    rows = rows_of(tuple(learn))
    chooses, anew = LOOPS in learn, any(row.anew for row in rows)
    corrects, trains = correct or any(row.corrects for row in rows), any(row.trains for row in rows)
    if chooses:
        require_no_cells(target_sparsity, target_flops, max_action_error)
    directory = Path(path)
    require_directory(directory)
    # All the while: a second calibration would undo the first.
    with locked(directory), opened_pool(ray) as pool, exact_arithmetic(place):
        artifact = load_artifact(directory)
        if anew:  # that of an earlier calibration would judge this one's plans
            artifact = replace(artifact, envelope=None)
        manifest = view_of(artifact, base_of(artifact)).manifest
        goal = goal_of(*asked, usual=usual_sparsity(manifest.steps))
        request = Request(goal, correct, max_intervals, rank, updates, margin=max_distance)
        if chooses:  # the distance is that of what is chosen in the end, and not of each that learns
            request = replace(request, margin=None, deadline_ms=latency_ms, by_time=True, threads=goal.threads)
            if max_distance is not None:
                request = replace(request, bound=max_distance, farthest=max_distance)
        proposers = [row.make(request) for row in rows]
        for proposer in proposers:
            if (reason := proposer.applies(artifact)) is not None:
                raise CalibrationError(reason)
        episodes = load_episodes(artifact.manifest.spec, trajectories, observation, artifact.tokenizer)
        rate = policy_hz or recorded_rate(trajectories) or (artifact.manifest.calibration or {}).get("policy_hz")
        chosen_anew = chooses and not trains  # weights are trained for what was best
        settings = {
            # Where plans stay, these too: what is learned is learned for one of them.
            "model": (artifact.manifest.model_identity if anew else artifact.manifest.identity)[:16],
            "trajectories": digest_of(episodes),
            # What is chosen in the end may be asked for anew of what was found: no search depends on it.
            "budget": None if chosen_anew else goal.record(),
            "threads": goal.threads if chooses else 1,
            "learn": [row.name for row in rows],
            "seed": seed,
            "validation_fraction": validation_fraction,
            "max_distance": None if chosen_anew else max_distance,
            "correct": correct,
            "device": "cpu" if place is None else str(place),
            "max_intervals": max_intervals,
            "rank": rank,
            "updates": updates,
        }
        state = StateFile(directory, settings)
        if not (resume and state.load()):
            state.remove()
        limits = calls_to_learn_from(manifest, max_minutes, corrects=corrects, trains=trains)
        # The number stays whatever time there is to go on.
        limits = limits._replace(usual=state.progress.setdefault("calls", limits.usual))
        clock = Clock(60 * max_minutes, float(state.progress.get("seconds", 0.0)) + begun.elapsed(), wall)
        with Bar(progress) as bar:
            opened = {"clock": clock, "bar": bar, "pool": pool, "device": place, "limits": limits}
            trials = Trials.of(artifact, episodes, state, seed=seed, fraction=validation_fraction, **opened)
            if chooses:
                require_two_calls(trials)
            warn_of_recordings(trials, rows, corrects)
            # Where a distance was allowed, no plan that is kept is too far away to be the default.
            kept = Kept(trials, anew, FARTHEST if max_distance is None else np.inf)
            _hear(kept, rows, proposers, clock, request)
            frontier = choose(kept, request) if chooses else None
            if frontier is not None:
                kept.keep_only(frontier.plans, frontier.scores, frontier.default)
                kept.plans |= frontier.spare
            else:
                kept.judge_changed(artifact.plans)
        # Where no schedule is learned: what one would have been asked for.
        schedule = next((one for one in proposers if isinstance(one, Schedule)), Schedule(request, SCHEDULES[0]))
        asked_of_default = {n: one for n, one in ((DISTANCE, max_distance), (LATENCY, latency_ms)) if one is not None}
        budget = asked_of_default if chooses else schedule.budget.record()
        result = _result(trials, rows, kept, frontier, schedule, budget, rate)
        _warn_of_result(bar, result, max_minutes, clock.left_out)
        _write(directory, artifact, result, kept, anew)
        if not (chooses and result.default_plan == DENSE):  # more time, or a larger error, may go on from there
            state.remove()
        return result


def _hear(kept: Kept, rows: Sequence[Row], proposers: Sequence[Proposer], clock: Clock, request: Request) -> None:
    """Have each proposer judged, in its share of the time. Raises CalibrationFailedError: nothing was kept."""
    takes = np.cumsum([row.takes for row in rows])
    if request.by_time:  # what others choose on, and what confirms, is answered first: nobody has to leave time for it
        for part in (LEARNED, CONFIRMING) if len(rows) > 1 else (CONFIRMING,):
            kept.trials.sample(part)
    for number, (row, proposer, share) in enumerate(zip(rows, proposers, takes / takes[-1], strict=True)):
        if request.by_time:
            clock.ahead[:] = [partial(seconds_to_time, kept, request.deadline_ms)]
            least = partial(seconds_to_judge, kept.trials, kept.plan, lowered=True)
            # It chooses among two ways at least, and the better one is judged.
            if number and not (kept.learned and clock.has(2 * least(LEARNED) + least(), row.name)):
                kept.refused[row.name] = "was not tried: there was no time for it"
                continue
            clock.ahead.append(partial(seconds_to_judge_others, kept, any(one.lowers for one in rows[number + 1 :])))
        kept.hear(row.name, proposer, clock.until(float(share)))
    if not (kept.learned or (request.by_time and clock.left_out)):
        why = " ".join(f"{name!r} {reason}" for name, reason in kept.refused.items())
        raise CalibrationFailedError(f"{why or 'nothing was proposed.'} The artifact is as it was.")
    for name, reason in kept.refused.items():
        kept.trials.bar.warn(f"{name!r} is left out: it {reason}")


def _result(
    trials: Trials,
    rows: Sequence[Row],
    kept: Kept,
    frontier: Frontier | None,
    schedule: Schedule,
    budget: Mapping[str, Any],
    rate: float | None,
) -> CalibrationResult:
    """What came of it; ``rate`` is ``policy_hz``."""
    split, clock = trials.split, trials.clock
    return CalibrationResult(
        learned=tuple(row.name for row in rows),
        seed=trials.seed,
        target_sparsity=schedule.budget.sparsity(trials.runner.view.manifest),
        default_plan=kept.default,
        plans=kept.scores,
        other_noise=other_noise(trials),
        policy_hz=rate,
        skipped={**schedule.skipped, **kept.refused},
        episodes={"calibration": split.calibration, "validation": split.validation},
        calls={"calibration": trials.used, "validation": len(trials.held_out.calls)},
        intervals=schedule.intervals,
        stopped=schedule.stopped or (TIME_LIMIT if clock.left_out else FINISHED),
        seconds=clock.elapsed(),
        budget=budget,
        told=kept.told,
        held_out=digest_of([trials.episodes[n] for n in split.validation]),
        frontier=() if frontier is None else frontier.tried,
        timed_on=None if frontier is None else timed_on(schedule.request.goal.threads),
    )


def _warn_of_result(bar: Bar, result: CalibrationResult, max_minutes: float, left_out: Sequence[str]) -> None:
    if result.stopped == TIME_LIMIT:
        told = f"{max_minutes:g} minutes were too few for all of it: with more, plans may be nearer to the original"
        bar.warn(f"{told}. Left out or cut short: {'; '.join(left_out) or 'the search'}.")
    if result.doubtful:
        bar.warn(
            f"plan {result.default_plan!r} is {result.plans[result.default_plan].distance:.2f} of what other noise"
            f" changes from the original; above {FARTHEST:g} scores may fall. Allow more time or computed cells, or"
            " record more."
        )


def _write(path: Path, artifact: Artifact, result: CalibrationResult, kept: Kept, anew: bool) -> None:
    """Put the plans into the artifact; ``anew`` in place of those that it has."""
    record = {} if anew else dict(artifact.manifest.calibration or {})
    own = result.record()
    own["plans"] = {**record.get("plans", {}), **own["plans"]}
    steps = {name: kept.notes[name]["steps"] for name in (SAFE, FAST) if name in kept.notes}
    own["learned"] = list(dict.fromkeys([*record.get("learned", []), *own["learned"]]))
    own["told"] = {**record.get("told", {}), **own["told"]}
    more: dict[str, Any] = {key: own[key] for key in ("plans", "learned", "told", "policy_hz") if key in own}
    record |= {**kept.notes.get(SCHEDULE, {}), **own, "named_steps": steps} if anew else more
    pruner, loop = (None, ORIGINAL) if kept.pruner is None else kept.pruner
    update_plans(
        path,
        kept.plans,
        result.default_plan,
        record,
        pruner_weights=pruner,
        pruner_loop=loop,
        weights=kept.weights,
        starts=kept.starts,
        envelope=kept.trials.envelope if anew or artifact.envelope is None else None,
        model_identity=artifact.manifest.model_identity,
        golden=record_plans,
        held=True,
    )
