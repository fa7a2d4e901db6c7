"""Weights of its own for a plan that computes very few steps: the last resort, where no correction helps.

The original's stay in the artifact, and all other plans compute with them. Residual blocks get low-rank changes, which
are trained until a sparse loop gives the dense policy's answers. The schedule and its correction stay as they are, and
so does step 0. What the loop carries to the next computed step is known, therefore, before training begins; from there
on the loop is differentiated. Low-rank changes: LoRA (arXiv 2106.09685); a policy of few steps that is trained to
answer as one of many: progressive distillation (arXiv 2202.00512), here for one schedule, from recorded observations
alone.
"""

import math
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...artifact.bind import unbound
from ...artifact.load import Artifact
from ...artifact.stores import BlockWeights
from ...artifact.view import view_of
from ...core.coercion import Array, Arrays
from ...core.lattice import Source, whole_steps_plan
from ...core.plan import ORIGINAL, Plan
from ...errors import CalibrationError, CalibrationFailedError
from ...ir.pieces import is_block
from ...lower.precision import quantize_model
from ...pool import workers
from ...runtimes.reference.sampler import Carried
from ..calls import Actions, Calls, IntArray
from ..clock import Clock
from ..kept import holding
from ..proposer import Proposal, Proposals, Proposer
from ..runner import Runner, StreamCaches, last
from ..sparse_loop import fit_correction
from ..trials import Trials

BATCH, PART = 64, 16
"""Calls of one update, and how many of them a thread differentiates at once: gradients are summed in this order,
however many threads there are."""

RATE, WARM_UP = 1e-3, 20
"""Of Adam, and the updates in which it grows to that."""

SCALE = 4.0
"""Of a change, over the root of its number of columns: so a rate that suits one size of a matrix suits others."""

LARGEST_GRADIENT = 1.0
"""Norm of the gradients of all factors together, above which they are made smaller."""

PREDICTED = 0.1
"""Weight of the whole prediction in the loss, beside 1 of what is executed: an executor plays what follows when a call
is late."""

SMALLEST = 2
"""A matrix is changed if both of its sides are at least so many times the rank."""


def trainable(artifact: Artifact, rank: int) -> tuple[str, ...]:
    """Constants that can be changed: matrices, or kernels, of residual blocks that no other piece reads."""
    others = {name for key, graph in artifact.graphs.items() if not is_block(key) for name in graph.constants}
    mine = {name for piece in artifact.pieces.blocks for name in piece.graph.constants} - others
    values = {name: artifact.weights[name] for name in mine}
    sizes = {n: min(_sides(a.shape)) for n, a in values.items() if a.dtype == np.float32 and a.ndim >= 2}
    found = tuple(sorted(name for name, size in sizes.items() if size >= SMALLEST * rank))
    if not found:
        most = max(sizes.values(), default=0) // SMALLEST
        remedy = f"Give a rank of at most {most}." if most else "This policy cannot be distilled."
        raise CalibrationError(
            f"rank {rank}: expected matrices of residual blocks whose sides are at least {SMALLEST * rank}, and that"
            f" no other piece reads; found none of {len(sizes)}. {remedy}"
        )
    return found


def _sides(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of a constant, all axes but the first as one."""
    return shape[0], math.prod(shape[1:])


@dataclass(frozen=True)
class Lesson:
    """Calls, and what their loop carries to step ``Student.begin``."""

    calls: Calls
    carried: Carried


class Student:
    """A policy whose blocks change by low-rank matrices after step 0.

    Args:
        runner: of a view with weights beside the original's, which this changes in place.
        plan: cells of whole steps, at least two of them computed, and their correction.
        seed: of the first changes, and of the order of the calls.

    Attributes:
        begin: the first step that is trained: the second that the plan computes.
    """

    def __init__(self, runner: Runner, plan: Plan, rank: int, seed: int, updates: int) -> None:
        assert plan.cells is not None
        self.runner = runner.corrected(plan.correction)
        self._cells, self._correction, self._seed, self._updates = plan.cells, plan.correction, seed, updates
        self._computed = (plan.cells == Source.COMPUTE).all(axis=1)
        self.begin = int(np.flatnonzero(self._computed)[1])
        self._actions = Actions(runner.view.manifest.spec)
        self._weights = {n: runner.model.weights[n].requires_grad_() for n in sorted(runner.view.first_weights)}
        self._original = {n: value.detach().clone() for n, value in self._weights.items()}
        draw = torch.Generator().manual_seed(seed)
        self._factors: dict[str, Tensor] = {}
        for name, value in self._original.items():
            rows, columns = _sides(tuple(value.shape))
            right = torch.randn(rank, columns, generator=draw) / math.sqrt(rank)
            self._factors[f"{name}/left"] = torch.zeros(rows, rank, device=value.device)
            self._factors[f"{name}/right"] = right.to(value.device)
        self._adam = torch.optim.Adam(list(self._factors.values()), lr=RATE)
        self.done = 0

    def lesson(self, calls: Calls) -> Lesson:
        """The calls as far as nothing of them is trained."""
        parts = [np.arange(i, min(i + PART, calls.count)) for i in range(0, calls.count, PART)]
        with workers() as pool:
            carried = list(pool.map(self._carried_to_begin, [self.runner.select(calls, part) for part in parts]))
        return Lesson(calls, Carried(*(torch.cat(each) for each in zip(*carried, strict=True))))

    def update(self, lesson: Lesson, passed: float) -> float:
        """Learn from one batch; its loss. The rate falls with the share of the time that passed, or with updates."""
        part = max(passed, self.done / self._updates)
        rate = RATE * min(1.0, (self.done + 1) / WARM_UP) * 0.5 * (1 + math.cos(math.pi * min(1.0, part)))
        batch = self._batch(lesson.calls.count)
        shares = [batch[i : i + PART] for i in range(0, len(batch), PART)]
        with workers() as pool:
            found = list(pool.map(partial(self._gradients, lesson, len(batch)), shares))
        for name, factor in self._factors.items():
            factor.grad = torch.stack([gradients[name] for _, gradients in found]).sum(0)
        torch.nn.utils.clip_grad_norm_(list(self._factors.values()), LARGEST_GRADIENT)
        for group in self._adam.param_groups:
            group["lr"] = rate
        self._adam.step()
        self.done += 1
        self._write()
        return sum(loss for loss, _ in found)

    def weights(self) -> dict[str, Array]:
        """The changed constants, by name."""
        return {name: value.detach().cpu().numpy().copy() for name, value in self._weights.items()}

    def state(self) -> dict[str, Array]:
        """Everything that going on needs but ``done``."""
        arrays = {f"factor/{name}": value.cpu().numpy() for name, value in self._factors.items()}
        for name, factor in self._factors.items():
            moments = self._adam.state[factor]
            arrays |= {f"{key}/{name}": moments[key].cpu().numpy() for key in ("exp_avg", "exp_avg_sq")}
        return arrays

    def restore(self, arrays: Arrays, done: int) -> None:
        """Go on after so many updates."""
        for name, factor in self._factors.items():
            factor.copy_(torch.from_numpy(arrays[f"factor/{name}"]))
            moments = {key: torch.from_numpy(arrays[f"{key}/{name}"]) for key in ("exp_avg", "exp_avg_sq")}
            there = {key: value.reshape(factor.shape).to(factor.device) for key, value in moments.items()}
            self._adam.state[factor] = {"step": torch.tensor(float(done)), **there}
        self.done = done
        self._write()

    def _batch(self, count: int) -> IntArray:
        """Numbers of the calls of the next update: all calls in a new order, again and again."""
        size = min(BATCH, count)
        turn, place = divmod(self.done, count // size)
        order = np.random.default_rng((self._seed, 6, turn)).permutation(count)
        return np.asarray(order[place * size : (place + 1) * size])

    def _carried_to_begin(self, calls: Calls) -> Carried:
        loop = self._loop(calls)
        with torch.no_grad():
            return deque((next(loop) for _ in range(self.begin)), maxlen=1).pop()

    def _gradients(self, lesson: Lesson, size: int, numbers: IntArray) -> tuple[float, dict[str, Tensor]]:
        """Loss of some calls of a batch, as their share of it, and its gradients by factor."""
        calls, index = self.runner.select(lesson.calls, numbers), torch.from_numpy(numbers)
        carried = Carried(*(value[index] for value in lesson.carried))
        with torch.enable_grad():
            sample = last(one.sample for one in self._loop(calls, (self.begin, carried)))
            executed = self._actions.executed(sample) - self._actions.executed(calls.targets)
            loss = executed.square().mean() + PREDICTED * (sample - calls.targets).square().mean()
            loss = loss * (len(numbers) / size)
            whole = torch.autograd.grad(loss, list(self._weights.values()))
        gradients = {}
        for name, gradient in zip(self._weights, whole, strict=True):
            left, right = self._factors[f"{name}/left"], self._factors[f"{name}/right"]
            matrix = gradient.reshape(len(left), -1) * _scale(right)
            gradients[f"{name}/left"], gradients[f"{name}/right"] = matrix @ right.T, left.T @ matrix
        return float(loss.detach()), gradients

    def _loop(self, calls: Calls, since: tuple[int, Carried] | None = None) -> Iterator[Carried]:
        """The sparse loop, whole or from a step on; idle steps add what the last computed one did."""
        caches, total = StreamCaches(), calls.initial

        def blocks(k: int, stem: Tensor) -> Tensor:
            nonlocal total
            if not self._computed[k]:
                return stem + total
            stream = self.runner.step(self._cells[k][None], k, stem, calls, caches)
            total = stream - stem
            return stream

        model = self.runner.model
        return model.steps_of(calls.contexts, calls.initial, calls.noise, blocks, self._correction, since=since)

    @torch.no_grad()
    def _write(self) -> None:
        for name, value in self._weights.items():
            left, right = self._factors[f"{name}/left"], self._factors[f"{name}/right"]
            value.copy_(self._original[name] + (left @ right * _scale(right)).reshape(value.shape))


def _scale(right: Tensor) -> float:
    return SCALE / math.sqrt(right.shape[1])


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

        def corrected(runner: Runner) -> Plan:
            return replace(plan, correction=fit_correction(runner, cells, calls, reads), weights=NAME)

        first, original = corrected(trials.runner), {name: trials.artifact.weights[name] for name in names}
        if plan.correction is None and first.correction is not None:  # what that alone does is no merit of the weights
            yield Proposal(trials.name, replace(plan, correction=first.correction))
        held = holding(trials, Proposal(NAME, first, weights={NAME: BlockWeights(original, {})}))
        there = Runner(view_of(held.artifact, first.exact), trials.device)
        student = Student(there, first, rank, trials.seed, updates)
        self._train(student, trials, clock.until(TRAINING))
        self.told = f"{len(names)} matrices of blocks were trained in {student.done} updates"
        notes, weights = {"rank": rank, "matrices": len(names), "updates": student.done}, student.weights()
        own = BlockWeights(weights, _in_precision(trials.artifact, weights))
        # What the trained weights predict is corrected anew; what they were trained with they only began from.
        yield Proposal(NAME, corrected(student.runner), notes, weights={NAME: own})

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
                state.save(updates=student.done, seconds=clock.elapsed())


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
        f" begins with noise and has the original's weights; plan {trials.name!r} is another one. Learn"
        " 'schedule', which makes such plans."
    )


def _in_precision(artifact: Artifact, weights: Mapping[str, Any]) -> dict[str, Any]:
    """The constants that the artifact's other precision makes of these weights, by name; none where it has none."""
    record, known, made = artifact.manifest.precision, {**artifact.weights, **weights}, dict[str, Any]()
    for name in filter(is_block, () if record is None else record.models):
        model = unbound(artifact.files / artifact.manifest.pieces[name].file, known)
        made |= quantize_model(model, known, precision=artifact.manifest.precision_name)[1]
    return made
