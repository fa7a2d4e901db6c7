"""Distillation, as one straight line: calibrated schedule -> correction -> trained weights -> judgement -> artifact.

The last resort, where a schedule computes so few steps that no correction mends it: the blocks of its later steps get
weights of their own. The original's stay in the artifact, and all other plans compute with them.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..artifact.distilled import DistilledWeights
from ..artifact.load import Artifact, load_artifact
from ..artifact.manifest import DISTILLED
from ..artifact.write import locked, update_calibration
from ..core.coercion import integer
from ..core.correction import Correction
from ..core.lattice import PlanArray, Source, whole_steps_plan
from ..errors import CalibrationError, CalibrationFailedError
from ..ir.pieces import is_block
from ..lower.precision import quantize_model
from ..runtimes.torch.devices import device_of, exact_arithmetic
from ..verification.record_golden import record_plans
from .arguments import JUDGED, calls_to_learn_from, require_directory, require_limits
from .calls import FRACTION, Actions, Calls, digest_of, load_episodes, split_episodes
from .clock import Clock
from .execute import Executor
from .fit_correction import fit_correction
from .judge import SCHEDULE
from .progress import Bar
from .result import PlanScore
from .state import DISTILLATION, StateFile
from .student import Student, trainable
from .targets import draw_calls, with_targets

UPDATES = 600
"""Of the weights, if there is time. On Push-T with 2 of 16 steps and 3,072 calls the held-out error has stopped falling
by then; with 12,288 calls it still falls after four times as many."""

SAVED = 20
"""Updates from one saving of the state to the next."""

TRAINING = 0.95
"""Share of the time limit after which the weights stay as they are: what follows takes the rest."""


@dataclass(frozen=True)
class Distilled:
    """What a distillation achieved, on episodes that it did not learn from.

    Attributes:
        plan: the schedule that was distilled.
        before: its score as it is, or with a correction fitted on the same calls, whichever is better.
        after: the score of the plan ``distilled``.
        rank: of the changes of the weights.
        matrices: how many were changed.
        updates: how many there were.
        calls: how many were learned from, and judged on.
        stopped: ``finished`` or ``time limit``.
        seconds: of work, the parts before an interruption included.
    """

    plan: str
    before: PlanScore
    after: PlanScore
    rank: int
    matrices: int
    updates: int
    calls: Mapping[str, int]
    stopped: str
    seconds: float

    def record(self) -> dict[str, Any]:
        """As JSON, for the artifact; without the time, so that the same distillation gives the same bytes."""
        record = asdict(self)
        del record["seconds"]
        return record


def distill(
    path: str | os.PathLike[str],
    trajectories: Sequence[str | os.PathLike[str]],
    plan: str = SCHEDULE,
    *,
    rank: int = 16,
    updates: int = UPDATES,
    seed: int = 0,
    max_minutes: float = 15.0,
    validation_fraction: float = FRACTION,
    observation: Mapping[str, Sequence[str]] | None = None,
    device: str | None = None,
    resume: bool = False,
    progress: bool = True,
) -> Distilled:
    """Train weights for the later steps of a schedule, until its actions are nearer to the dense policy's.

    The artifact gets the plan ``distilled``: the same schedule, with a correction and with weights of residual blocks
    of its own, which it has from its second computed step on. It becomes the default plan. The original's weights stay,
    and all other plans, ``dense`` among them, compute with them. The next calibration drops it.

    Args:
        path: the directory of a calibrated artifact.
        trajectories: see ``calibrate``. Those that it was calibrated with, or more.
        plan: a schedule of the artifact that computes whole steps, two of them at least.
        rank: of the changes of each matrix.
        updates: of the weights.
        seed: of the split, the noise and the training; that of the calibration keeps the same episodes held out.
        max_minutes: training ends in time to be finished by then; then the outcome depends on the machine's speed.
        validation_fraction: see ``calibrate``.
        observation: see ``calibrate``.
        device: see ``calibrate``.
        resume: go on where a distillation with the same arguments was interrupted; begins anew if none was.
        progress: show a bar on standard error.

    Returns:
        What was achieved.

    Raises:
        CalibrationFailedError: the distilled plan is no better on held-out episodes. The artifact is as it was.
        CalibrationError: the arguments cannot be satisfied, or there is nothing to resume with these.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: no artifact, one that another process is changing, or it cannot be written.
        RuntimeUnavailableError: torch does not have the device.
    """
    begun = time.monotonic()
    seed = integer(seed, "seed", CalibrationError)
    rank = integer(rank, "rank", CalibrationError, 1)
    updates = integer(updates, "updates", CalibrationError, 1)
    require_limits(validation_fraction, max_minutes)
    there = None if device is None else device_of(device)
    directory = Path(path)
    require_directory(directory)
    with locked(directory), exact_arithmetic(there):
        artifact = load_artifact(directory)
        spec, schedule = artifact.manifest.spec, _schedule(artifact, plan)
        trainable(artifact, rank)  # before minutes of work
        episodes = load_episodes(spec, trajectories, observation)
        split = split_episodes(len(episodes), validation_fraction, seed)
        fewest, limit = calls_to_learn_from(artifact.manifest, max_minutes, corrects=True, distils=True)
        settings = {
            "model": artifact.manifest.model_identity[:16],
            "trajectories": digest_of(episodes),
            "steps": np.flatnonzero(schedule[:, 0] == Source.COMPUTE).tolist(),
            "rank": rank,
            "updates": updates,
            "seed": seed,
            "validation_fraction": validation_fraction,
            "device": "cpu" if there is None else str(there),
        }
        state = StateFile(directory, settings, DISTILLATION)
        if not (resume and state.load()):
            state.remove()
        limit = state.progress.setdefault("calls", limit)
        clock = Clock(60 * max_minutes, float(state.progress.get("seconds", 0.0)), begun)
        executor = Executor(artifact, there)
        with Bar(progress) as bar:
            drawn = draw_calls(executor, spec, episodes, split, limit, min(JUDGED, limit // 2), seed)
            sets = {name: with_targets(executor, name, c, fewest, state, clock, bar) for name, c in drawn.items()}
            known = artifact.corrections.get(plan)
            correction = fit_correction(executor, schedule, sets["calibration"], known is None or known.reads > 0)
            student = Student(artifact, schedule, correction, rank, seed, updates, there)
            _train(student, sets["calibration"], state, clock.until(TRAINING), bar, updates)
        weights = student.weights()
        tried = [executor.corrected(one) for one in (correction, known)]
        before = min((_score(artifact, one, schedule, sets["validation"]) for one in tried), key=lambda one: one.error)
        # What the trained weights predict is corrected anew; what they were trained with they only began from.
        correction = fit_correction(student.executor, schedule, sets["calibration"], known is None or known.reads > 0)
        after = _score(artifact, student.executor.corrected(correction), schedule, sets["validation"])
        if not after.error < before.error:
            raise CalibrationFailedError(
                f"plan {plan!r} is {before.error:.4g} off on average on the held-out calls, and {after.error:.4g} with"
                f" trained weights after {student.done} updates. The artifact is as it was. Distil with more episodes"
                " or more time."
            )
        result = Distilled(
            plan=plan,
            before=before,
            after=after,
            rank=rank,
            matrices=len(weights),
            updates=student.done,
            calls={name: calls.count for name, calls in sets.items()},
            stopped="finished" if student.done == updates else "time limit",
            seconds=clock.elapsed(),
        )
        distilled = DistilledWeights(weights, _in_precision(artifact, weights))
        _write(directory, artifact, result, schedule, correction, distilled)
        state.remove()
        return result


def _schedule(artifact: Artifact, plan: str) -> PlanArray:
    """The schedule of this name, if it can be distilled."""
    if plan not in artifact.schedules or plan == DISTILLED:
        known = [name for name in artifact.schedules if name != DISTILLED]
        remedy = f"Give one of {known}" if known else "Calibrate the artifact first"
        raise CalibrationError(f"{artifact.path}: has no schedule {plan!r} that could be distilled. {remedy}.")
    schedule = artifact.schedule(plan)
    steps = np.flatnonzero((schedule == Source.COMPUTE).all(axis=1)).tolist()
    if len(steps) < 2 or not np.array_equal(schedule, whole_steps_plan(len(schedule), schedule.shape[1], steps)):
        raise CalibrationError(
            f"plan {plan!r}: expected whole steps, at least two of them computed, and TIMESTEP elsewhere; found another"
            " plan. Calibrate with strategy 'tts', which makes such plans."
        )
    return schedule


def _train(student: Student, calls: Calls, state: StateFile, clock: Clock, bar: Bar, updates: int) -> None:
    """All updates, or as many as there is time for; the state is saved on the way."""
    lesson = student.lesson(calls)
    done = int(state.progress.get("updates", 0))
    if done:
        with state.reading():
            student.restore(state.get("student"), done)
    bar.stage("distil", updates, done)
    first = float(state.progress.setdefault("training began", clock.elapsed()))  # the rate falls with what it has taken
    for _ in clock.in_time(range(done, updates)):
        loss = student.update(lesson, (clock.elapsed() - first) / max(clock.limit - first, 1e-9))
        bar.update(student.done, f"loss {loss:.2e}", clock.left())
        if student.done % SAVED == 0:
            state.put("student", student.state())
            state.progress.update(updates=student.done, seconds=clock.elapsed())
            state.save()


def _score(artifact: Artifact, executor: Executor, schedule: PlanArray, calls: Calls) -> PlanScore:
    errors = Actions(artifact.manifest.spec).errors(executor.run(schedule, calls), calls.targets, units=True)
    return PlanScore.of(errors, schedule[None], artifact.manifest.flops, pruned=False, correction=executor.correction)


def _in_precision(artifact: Artifact, weights: Mapping[str, Any]) -> dict[str, Any]:
    """The constants that the artifact's other precision makes of these weights, by name; none where it has none."""
    import onnx

    record, known, made = artifact.manifest.precision, {**artifact.weights, **weights}, dict[str, Any]()
    for name in filter(is_block, () if record is None else record.models):
        model = onnx.load(artifact.files / artifact.manifest.pieces[name].file, load_external_data=False)
        made |= quantize_model(model, known)[1]
    return made


def _write(
    directory: Path,
    artifact: Artifact,
    result: Distilled,
    schedule: PlanArray,
    correction: Correction | None,
    distilled: DistilledWeights,
) -> None:
    """Add the plan to those of the artifact."""
    record = dict(artifact.manifest.calibration or {})
    score, yardstick = asdict(result.after), record.get("other_noise")
    if yardstick:
        score["of_other_noise"] = result.after.error / yardstick
    pruned = any(plan.pruned for plan in artifact.manifest.plans.values())
    update_calibration(
        directory,
        artifact.pruner if pruned else None,
        {**artifact.schedules, DISTILLED: schedule},
        DISTILLED,
        {
            **record,
            "plans": {**record.get("plans", {}), DISTILLED: score},
            "default_plan": DISTILLED,
            DISTILLED: result.record(),
        },
        corrections={**artifact.corrections, **({} if correction is None else {DISTILLED: correction})},
        distilled=distilled,
        model_identity=artifact.manifest.model_identity,
        golden=record_plans,
        held=True,
    )
