"""Corrections for criteria that decide during the call: by step, and by how long ago one was computed whole.

A correction is fitted to a schedule, and with a criterion there is none before the call. But what a step needs depends
on few things: which step it is, its features, and how many steps ago all blocks were computed, its *age*. So there is a
correction for each age, and a stream takes row k of the one that has its age at step k::

    age 0    the step is computed whole, and enters the history
    age 1    the one before was
    ...

They are fitted as others are (``calibration.sparse_loop``): the criterion decides calls to learn from, and each step is
fitted where the loop is when it gets there, corrected so far. An age that too few of them have at a step has what all
calls together have there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ttscompile.calibration.calls import Calls
from ttscompile.calibration.regression import Components, Solved, solve
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.task import Task
from ttscompile.core.correction import Correction, components_of, groups_of, numbers_of
from ttscompile.core.lattice import Source
from ttscompile.errors import CalibrationError
from ttscompile.rivals.deciding import Table
from ttscompile.rivals.online import Criterion, decide, deciding_blocks
from ttscompile.runtimes.reference.sampler import Carried, features

LEAST = 160
"""Calls of an age at a step, from which on it has a correction of its own: features and components are as many."""

QUARTERS = 4
"""One episode of so many says what is better, and the others are fitted on."""

STREAMS = 256
"""Calls that go through the loop at once."""

ALL = -1
"""In the place of an age: of all calls."""


@dataclass(frozen=True)
class Tabled:
    """What was found for a criterion.

    Attributes:
        table: the corrections; empty where calls are nearer to the original without.
        errors: on episodes that were not fitted on, normalised: without a correction, with one for each step, and with
            one for each step and age.
    """

    table: Table
    errors: tuple[float, float, float]


class _Loop:
    """Some calls, whose steps a criterion decides.

    Attributes:
        ages: of each call at the step that was predicted last, ``[n]``.
    """

    def __init__(self, runner: Runner, criterion: Criterion, calls: Calls) -> None:
        self._model, self._calls, self._rows = runner.model, calls, list[Any]()
        self._blocks = deciding_blocks(runner, criterion, calls, self._rows)
        self._carried = self._following = self._model.sampler.begin(calls.initial)
        self._prediction, self.ages = calls.initial, np.zeros(calls.count, np.int64)

    @property
    def sample(self) -> Tensor:
        """``[n, T, D]``."""
        return self._carried.sample

    def predict(self, k: int) -> Tensor:
        """Go through step k without its correction: the features of that, ``[D, n, 6 T]``."""
        model, calls = self._model, self._calls
        self._prediction = model.predict(self._carried.sample, k, calls.contexts, self._blocks)
        self.ages = np.where(self._rows[-1][:, -1] == Source.COMPUTE, 0, self.ages + 1)
        noise = None if calls.noise is None else calls.noise[k]
        self._following = model.sampler.advance(self._carried, self._prediction, noise, k)
        return features(self._carried, self._prediction)

    def missing(self, k: int) -> Tensor:
        """To the sample that the original has after step k, ``[D, n, T]``."""
        assert self._calls.path is not None
        return (self._calls.path[:, k] - self._following.sample).permute(2, 0, 1)

    def correct(self, k: int, added: Tensor) -> None:
        """Finish step k, with ``added [D, n, T]`` to the sample."""
        before, following = self._carried, self._following
        half = before.history.shape[1] // 2
        entered = torch.cat([before.sample, self._prediction, before.history[:, :half]], 1)
        history = torch.where(torch.from_numpy(self.ages == 0)[:, None, None], entered, before.history)
        corrected = Carried(following.sample + added.permute(1, 2, 0), following.memory, history)
        self._carried = self._model.sampler.bounded(corrected, k)


@torch.no_grad()
def fit_ages(
    runner: Runner, criterion: Criterion, fitted: Calls, others: Calls, reads: bool, by_age: bool = True
) -> tuple[Table, Tensor]:
    """The corrections, and what calls answer with them that they were not fitted on, ``[N, T, D]``.

    Args:
        fitted: with their dense paths.
        reads: whether corrections may read the observation.
        by_age: otherwise all ages of a step have the same.
    """
    model = runner.model
    sample, condition = (fitted.initial.shape[1], fitted.initial.shape[2]), model.condition(fitted.contexts)
    most = components_of(model.steps, sample, numbers_of([tuple(condition.shape[1:])])) if reads else 0
    components, groups = Components.of(condition, most), groups_of(model.steps, sample)
    known = torch.cat([components.values, components.of_others(model.condition(others.contexts))])
    learning, judged = (
        [_Loop(runner, criterion, runner.select(calls, part)) for part in calls.parts(STREAMS)]
        for calls in (fitted, others)
    )
    batches, rows = [*learning, *judged], list[dict[int, Solved]]()
    ends = np.cumsum([len(batch.ages) for batch in batches])[:-1].tolist()
    for k in range(model.steps):
        read = torch.cat([batch.predict(k) for batch in batches], 1)
        missing = torch.cat([batch.missing(k) for batch in learning], 1)
        ages = np.concatenate([batch.ages for batch in batches])
        row, added = dict[int, Solved](), torch.zeros(len(read), len(known), sample[0])
        for age in (ALL, *np.unique(ages).tolist()):
            some = torch.from_numpy(np.flatnonzero((ages == age) | (age == ALL)))
            own = some[some < fitted.count]
            if age == ALL or (by_age and len(own) >= LEAST):
                row[age] = _solved(read[:, own], known[own], missing[:, own], groups)
            weight, bias, observed = row.get(age, row[ALL])
            added[:, some] = read[:, some] @ weight + bias + torch.einsum("nf,fdt->dnt", known[some].float(), observed)
        for batch, part in zip(batches, added.tensor_split(ends, 1), strict=True):
            batch.correct(k, part)
        rows.append(row)
    oldest = max(1, *(age for row in rows for age in row))  # age 0 alone is an anchor
    table = tuple(_of_age(age, rows, components) for age in range(oldest + 1))
    return table, torch.cat([batch.sample for batch in judged])


def _solved(read: Tensor, known: Tensor, missing: Tensor, groups: int) -> Solved:
    """See ``solve``; the mean of the components need not be 0."""
    center = known.mean(0)
    weight, bias, observed = solve(read.double(), known - center, missing.double(), groups)
    return Solved(weight, bias - torch.einsum("f,fdt->dt", center.float(), observed)[:, None], observed)


def _of_age(age: int, rows: list[dict[int, Solved]], components: Components) -> Correction:
    """The correction that streams of an age take at each step."""
    columns = zip(*(row.get(age, row[ALL]) for row in rows), strict=True)
    weights, biases, observed = (np.stack([each.numpy() for each in column]) for column in columns)
    observed = np.ascontiguousarray(observed.transpose(1, 0, 2, 3))
    biases = biases - np.einsum("f,fkdt->kdt", components.center, observed)[:, :, None]
    return Correction(np.full(len(rows), age == 0), weights, biases.astype(np.float32), components.reading, observed)


def fit_table(task: Task, criterion: Criterion) -> Tabled:
    """The corrections of a criterion, fitted on all calls to learn from, if they are better on some of the episodes.

    Raises:
        CalibrationError: the calls are of one episode.
    """
    runner, calls = task.runner, task.calls
    if len(np.unique(calls.episodes)) < 2:
        raise CalibrationError("corrections are judged on episodes that they are not fitted on; record more than one.")
    apart = np.isin(calls.episodes, np.unique(calls.episodes)[::QUARTERS])
    fitted, judged = (runner.select(calls, np.flatnonzero(some)) for some in (~apart, apart))
    reads = task.whole.reads(max(1, task.budget // runner.model.blocks))
    answers = [decide(runner, criterion, judged).samples]
    answers += [fit_ages(runner, criterion, fitted, judged, reads, by_age)[1] for by_age in (False, True)]
    plain, stepwise, aged = (float(task.actions.errors(one, judged.targets, units=False).mean()) for one in answers)
    if plain <= min(stepwise, aged):
        return Tabled((), (plain, stepwise, aged))
    table, _ = fit_ages(runner, criterion, calls, judged, reads, aged < stepwise)
    return Tabled(table, (plain, stepwise, aged))
