"""Weights of its own for a plan that computes very few steps: the last resort, where no correction helps.

The original's stay in the artifact, and all other plans compute with them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ...artifact.load import Artifact
from ...artifact.stores import BlockWeights
from ...artifact.view import view_of
from ...core.lattice import Source, whole_steps_plan
from ...core.plan import ORIGINAL, Plan
from ...errors import CalibrationError, CalibrationFailedError
from ...ir.pieces import is_block
from ...lower.precision import quantize_model
from ..clock import Clock
from ..execute import Executor
from ..kept import holding
from ..proposer import Proposal, Proposals, Proposer
from ..sparse_loop import fit_correction
from ..trials import Trials
from .student import Student, trainable

NAME = "distilled"
"""Of the plan, and of its weights."""

SAVED = 20
"""Updates from one saving of the state to the next."""

TRAINING = 0.95
"""Share of the time limit after which the weights stay as they are: what follows takes the rest."""


class Weights(Proposer):
    """Trains low-rank changes of the blocks' matrices until the plan answers as the dense policy does."""

    def applies(self, artifact: Artifact) -> str | None:
        """Whether blocks have matrices of their own that are large enough."""
        try:
            trainable(artifact, self.request.rank)
        except CalibrationError as error:
            return str(error)
        return None

    def propose(self, trials: Trials, plan: Plan, clock: Clock) -> Proposals:
        """The plan with trained weights, and a correction of what these predict."""
        _require_whole_steps(trials, plan)
        cells, calls = np.asarray(plan.cells), trials.calls
        reads = plan.correction is None or plan.correction.reads > 0
        rank, updates = self.request.rank, self.request.updates
        names = trainable(trials.artifact, rank)

        def corrected(executor: Executor) -> Plan:
            return replace(plan, correction=fit_correction(executor, cells, calls, reads), weights=NAME)

        first, original = corrected(trials.executor), {name: trials.artifact.weights[name] for name in names}
        if plan.correction is None and first.correction is not None:  # what that alone does is no merit of the weights
            yield Proposal(trials.name, replace(plan, correction=first.correction))
        held = holding(trials, Proposal(NAME, first, weights={NAME: BlockWeights(original, {})}))
        there = Executor(view_of(held.artifact, first.exact), trials.device)
        student = Student(there, first, rank, trials.seed, updates)
        self._train(student, trials, clock.until(TRAINING))
        self.told = f"{len(names)} matrices of blocks were trained in {student.done} updates"
        notes, weights = {"rank": rank, "matrices": len(names), "updates": student.done}, student.weights()
        own = BlockWeights(weights, _in_precision(trials.artifact, weights))
        # What the trained weights predict is corrected anew; what they were trained with they only began from.
        yield Proposal(NAME, corrected(student.executor), notes, weights={NAME: own})

    def _train(self, student: Student, trials: Trials, clock: Clock) -> None:
        """All updates, or as many as there is time for; the state is saved on the way."""
        state, lesson = trials.state, student.lesson(trials.calls)
        done = int(state.progress.get("updates", 0))
        if done:
            with state.reading():
                student.restore(state.get("weights"), done)
        trials.bar.stage("distil", self.request.updates, done)
        # The rate falls with what training has taken.
        first = float(state.progress.setdefault("training began", clock.elapsed()))
        for _ in clock.in_time(range(done, self.request.updates)):
            loss = student.update(lesson, (clock.elapsed() - first) / max(clock.limit - first, 1e-9))
            trials.bar.update(student.done, f"loss {loss:.2e}", clock.left())
            if student.done % SAVED == 0:
                state.put("weights", student.state())
                state.progress |= {"updates": student.done, "seconds": clock.elapsed()}
                state.save()


def _require_whole_steps(trials: Trials, plan: Plan) -> None:
    """Raise CalibrationFailedError unless a plan can be distilled."""
    cells = plan.cells
    if cells is not None and plan.loop == trials.base.loop and plan.weights == ORIGINAL:
        steps = np.flatnonzero((cells == Source.COMPUTE).all(axis=1)).tolist()
        whole = whole_steps_plan(len(cells), cells.shape[1], steps)
        if 1 < len(steps) < len(cells) and np.array_equal(cells, whole):
            return
    raise CalibrationFailedError(
        "weights are trained for a schedule of whole steps, two of them computed at least and TIMESTEP elsewhere, that"
        f" begins with noise and has the original's weights; plan {trials.name!r} is another one. Learn 'schedule' with"
        " strategy 'tts', which makes such plans."
    )


def _in_precision(artifact: Artifact, weights: Mapping[str, Any]) -> dict[str, Any]:
    """The constants that the artifact's other precision makes of these weights, by name; none where it has none."""
    import onnx

    record, known, made = artifact.manifest.precision, {**artifact.weights, **weights}, dict[str, Any]()
    for name in filter(is_block, () if record is None else record.models):
        model = onnx.load(artifact.files / artifact.manifest.pieces[name].file, load_external_data=False)
        made |= quantize_model(model, known)[1]
    return made
