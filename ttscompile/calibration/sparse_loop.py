"""The sparse loop, step by step, on calls that its corrections are fitted on while it goes, and on others beside them.

A place in the loop is a value: several schedules can go on from one, and what they have in common is computed once.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..core.correction import Correction, components_of, groups_of, jumps_of, may_jump, numbers_of
from ..core.lattice import BoolArray, PlanArray, Source
from ..pool import workers
from ..runtimes.reference.sampler import correct, features, hold, through
from .calls import Calls
from .regression import Components, Layers, Solved, fit_jump, solve
from .runner import Runner, StreamCaches

STREAMS = 64
"""Calls that go through the loop at once."""

TERMS = (fit_jump,)
"""Ways to fit what is added where a jump ends; of those that hold, the one that leaves least over is taken."""

ANCHOR_SHARE = 0.5
"""Of the blocks that a step computes, from which on it is an anchor."""


def anchors_of(plan: PlanArray) -> BoolArray:
    """Steps of a plan ``[K, blocks]``, or on average of plans ``[N, K, blocks]``, that compute half of their blocks."""
    computed = (plan == Source.COMPUTE).reshape(-1, *plan.shape[-2:])
    return np.asarray(computed.mean(axis=(0, 2)) >= ANCHOR_SHARE)


def is_whole(plan: PlanArray) -> bool:
    """Whether this is one plan ``[K, blocks]`` whose steps compute all blocks, or read TIMESTEP in all of them."""
    known = np.isin(plan, (Source.COMPUTE, Source.TIMESTEP)).all()
    return plan.ndim == 2 and bool(known and (plan == plan[:, :1]).all())


@dataclass(frozen=True)
class Place:
    """Calls before a step of a sparse loop: those to fit corrections on, others that go along, and jumps that hold."""

    step: int
    fitted: tuple[_Batch, ...]
    judged: tuple[_Batch, ...]
    solved: tuple[Solved, ...] = ()
    anchors: tuple[bool, ...] = ()
    jumps: Mapping[int, Layers] = field(default_factory=dict)

    @property
    def batches(self) -> tuple[_Batch, ...]:
        """Of all calls, the fitted ones first."""
        return *self.fitted, *self.judged

    @property
    def samples(self) -> Tensor:
        """Those of the judged calls, ``[N, T, D]``."""
        return torch.cat([batch.sample for batch in self.judged])

    @property
    def held(self) -> list[Tensor]:
        """Its samples and residuals. Places share the tensors that no step between them changed."""
        return [tensor for batch in self.batches for tensor in batch.held]

    def forked(self, **fields: Any) -> Place:
        """Another one with other fields, whose batches go on without moving those of this one."""
        fitted, judged = (tuple(batch.fork() for batch in part) for part in (self.fitted, self.judged))
        return replace(self, fitted=fitted, judged=judged, **fields)


class SparseLoop:
    """The sparse loop of some calls.

    Args:
        runner: runs the policy; its own correction is not used.
        fitted: calls with their dense paths, that corrections are fitted on; None for a loop without corrections.
        judged: others; None for none.
        reads: whether corrections may read the observation.
        whole: whether all plans are whole, see ``is_whole``; then places are small.

    Attributes:
        begin: the place before step 0.
    """

    def __init__(self, runner: Runner, fitted: Calls | None, judged: Calls | None, *, reads: bool, whole: bool) -> None:
        self._components: Components | None = None
        self._groups, self._numbers, self._known, self._prefixes = 0, 0, torch.empty(0, 0), 0
        if fitted is not None:
            steps, sample = runner.model.steps, (fitted.initial.shape[1], fitted.initial.shape[2])
            condition = runner.model.condition(fitted.contexts)
            self._numbers = numbers_of([tuple(condition.shape[1:])])
            most = components_of(steps, sample, self._numbers) if reads else 0
            self._components, self._groups = Components.of(condition, most), groups_of(steps, sample)
            others = [] if judged is None else [self._components.of_others(runner.model.condition(judged.contexts))]
            self._known = torch.cat([self._components.values, *others]).float()
            self._episodes = fitted.episodes
            self._prefixes = 0 if fitted.known is None else fitted.known.values.shape[2]

        def batches(calls: Calls | None) -> tuple[_Batch, ...]:
            if calls is None:
                return ()
            parts, sums = calls.parts(STREAMS), whole and runner.alike
            return tuple(_Batch(runner, runner.select(calls, part, consecutive=True), sums) for part in parts)

        self.begin = Place(0, batches(fitted), batches(judged))
        # Where an axis of all calls is cut into those of the batches.
        self._ends: list[int] = np.cumsum([len(batch.sample) for batch in self.begin.batches])[:-1].tolist()

    def after(self, place: Place, rows: PlanArray, pool: ThreadPoolExecutor) -> Place:
        """The place after one step more, of one row of a plan for all calls, ``[1, blocks]``, or one for each."""
        anchor = bool(anchors_of(rows[:, None])[0])
        there = place.forked(step=place.step + 1, anchors=(*place.anchors, anchor))
        own = [rows] * len(there.batches) if len(rows) == 1 else np.split(rows, self._ends)
        list(pool.map(partial(_Batch.predict, k=place.step), there.batches, own))
        if self._components is None:
            return there
        read, missing = (torch.cat(column, 1) for column in zip(*map(_Batch.missing, there.fitted), strict=True))
        solved = solve(read.double(), self._components.values, missing.double(), self._groups)
        added = solved.bias + torch.einsum("nf,fdt->dnt", self._known, solved.observed)
        for batch, part in zip(there.batches, added.tensor_split(self._ends, dim=1), strict=True):
            batch.correct(solved.weight, part, anchor)
        return replace(there, solved=(*place.solved, solved))

    def end(self, plan: PlanArray) -> Place:
        """The place after the last step of a plan ``[K, blocks]``, or of one for each call, ``[N, K, blocks]``."""
        place, plans = self.begin, plan.reshape(-1, *plan.shape[-2:])
        with workers() as pool:
            for k in range(plans.shape[1]):
                place = self.after(place, plans[:, k], pool)
        return place

    def ends(self, plan: PlanArray) -> tuple[Place, Place]:
        """The same without jumps, and with those that hold on other episodes; one place twice where none does."""
        plain, plans = self.begin, plan.reshape(-1, *plan.shape[-2:])
        landings = set(jumps_of(anchors_of(plan)).values())
        jumping = None  # while no jump has held, the two are one
        with workers() as pool:
            for k in range(plans.shape[1]):
                jumping = jumping and self.after(jumping, plans[:, k], pool)
                plain = self.after(plain, plans[:, k], pool)
                if k in landings:
                    jumping = self._jumped(jumping or plain) or jumping
        return plain, jumping or plain

    def _jumped(self, place: Place) -> Place | None:
        """The place after the jump that ends there; None if that does not hold."""
        known = torch.cat([self._known, torch.cat([batch.history for batch in place.batches])], 1)
        missing, landing = torch.cat([batch.left for batch in place.fitted]), place.step - 1
        fitted_terms = (fit(known[: len(missing)], missing, self._episodes, landing) for fit in TERMS)
        held = [one for one in fitted_terms if one is not None]
        if not held:
            return None
        layers, added = min(held, key=lambda one: float((missing - one[1]).square().mean()))
        added = torch.cat([added, through(layers, known[len(missing) :])])
        there = place.forked(jumps={**place.jumps, landing: layers})
        for batch, part in zip(there.batches, added.tensor_split(self._ends), strict=True):
            batch.add(part)
        return there

    def correction(self, place: Place) -> Correction | None:
        """What was fitted, at the place after the last step of a loop with corrections; None if that is no numbers."""
        assert self._components is not None
        if not all(bool(torch.isfinite(one).all()) for solved in place.solved for one in solved):
            return None
        columns = zip(*place.solved, strict=True)
        weights, biases, observed = (np.stack([each.numpy() for each in column]) for column in columns)
        observed = np.ascontiguousarray(observed.transpose(1, 0, 2, 3))
        # Fitted to components of mean 0; a call reads them with their center, so that is taken out of what is added.
        biases = biases - np.einsum("f,fkdt->kdt", self._components.center, observed)[:, :, None]
        anchors, reading = np.array(place.anchors), self._components.reading
        without = Correction(anchors, weights, biases.astype(np.float32), reading, observed, prefixes=self._prefixes)
        if not place.jumps:
            return without
        absent = tuple(torch.zeros_like(layer) for layer in next(iter(place.jumps.values())))
        all_jumps = [place.jumps.get(landing, absent) for landing in jumps_of(anchors).values()]
        inner, middle, outer = (
            np.stack([layer.numpy() for layer in column]) for column in zip(*all_jumps, strict=True)
        )
        inner[:, -1] -= self._components.center @ inner[:, : reading.shape[1]]
        found = (np.isfinite(layer).all() for layer in (inner, middle, outer))
        if not reading.shape[1]:  # nothing is read, and a jump says of how many numbers
            reading = np.zeros((self._numbers, 0), np.float32)
        return replace(without, reading=reading, inner=inner, middle=middle, outer=outer) if all(found) else None


class _Batch:
    """Some of the calls at a place; with ``sums`` residuals are kept as their sum, which is enough for whole steps."""

    def __init__(self, runner: Runner, calls: Calls, sums: bool) -> None:
        self._runner, self._calls, self._sums = runner, calls, sums
        self._caches, self._total = StreamCaches(), calls.initial
        self._carried = self._before = runner.model.sampler.begin(calls.initial)
        self._k, self._prediction = 0, calls.initial

    @property
    def sample(self) -> Tensor:
        """``[n, T, D]``."""
        return self._carried.sample

    @property
    def held(self) -> list[Tensor]:
        """See ``Place``."""
        return [*self._carried, self._total, *self._caches.timestep.values()]

    def fork(self) -> _Batch:
        """Another one at the same place; what happens to one of the two does not happen to the other."""
        other = copy(self)
        other._caches = self._caches.copy()
        return other

    def predict(self, rows: PlanArray, k: int) -> None:
        """Go through step k, without a correction; ``rows`` of plans, ``[1 or n, blocks]``."""
        model, calls = self._runner.model, self._calls

        def blocks(k: int, stem: Tensor) -> Tensor:
            if self._sums and rows[0, 0] != Source.COMPUTE:
                return stem + self._total
            stream = self._runner.step(rows, k, stem, calls, self._caches)
            if self._sums:
                self._total, self._caches = stream - stem, StreamCaches()
            return stream

        self._before = hold(self._carried, calls.known, k)
        self._k, self._prediction = k, model.predict(self._before.sample, k, calls.contexts, blocks)
        noise = None if calls.noise is None else calls.noise[k]
        self._carried = model.sampler.advance(self._before, self._prediction, noise, k)

    def missing(self) -> tuple[Tensor, Tensor]:
        """Features of the step, ``[D, n, 6 T]``, and what is missing after it, ``[D, n, T]``."""
        assert self._calls.path is not None
        missing = (self._calls.path[:, self._k] - self._carried.sample).permute(2, 0, 1)
        return features(self._before, self._prediction), missing

    @property
    def history(self) -> Tensor:
        """What a jump reads of it, ``[n, D 4 T]``."""
        return self._carried.history.transpose(1, 2).reshape(len(self.sample), -1)

    @property
    def left(self) -> Tensor:
        """What is missing after the corrected step, ``[n, D T]``."""
        assert self._calls.path is not None
        return (self._calls.path[:, self._k] - self.sample).transpose(1, 2).reshape(len(self.sample), -1)

    def add(self, added: Tensor) -> None:
        """Add ``[n, D T]`` to the sample."""
        _, horizon, dimensions = self.sample.shape
        part = added.reshape(-1, dimensions, horizon).transpose(1, 2)
        self._carried = self._carried._replace(sample=self.sample + part)

    def correct(self, weight: Tensor, added: Tensor, anchor: bool) -> None:
        """Correct the step: weights ``[G, 6 T, T]``, and what is added beside, ``[D, n, T]``."""
        carried = correct(self._before, self._prediction, self._carried, weight, added, anchor)
        self._carried = self._runner.model.sampler.bounded(carried, self._k)


def fit_correction(runner: Runner, plan: PlanArray, calls: Calls, reads: bool) -> Correction | None:
    """``fitted_alone``, and beside it that of calls with a prefix: one for both is further away than two are."""
    own = fitted_alone(runner, plan, calls, reads)
    if own is None or calls.late is None:
        return own
    some = plan if plan.ndim == 2 else plan[: calls.late.count]
    return replace(own, late=fitted_alone(runner, some, calls.late, reads))


def fitted_alone(runner: Runner, plan: PlanArray, calls: Calls, reads: bool) -> Correction | None:
    """The correction of a schedule, or one for all plans of a pruner; None where the sparse loop ends in no numbers.

    At step k the sparse loop, corrected so far, has features; the correction of the step is the ridge regression, on
    these and on the principal components of the condition, of what is missing to the sample that the dense policy has
    after the step with the same noise. Then all calls go on with it. So every step is fitted where the loop will be
    when it gets there, and what one step leaves over the next can still repair. One pass of sparse calls: seconds.
    Where the steps between two anchors end, a jump is fitted to what the corrections leave over, if it holds on other
    episodes. Jumps stay if the loop then ends nearer to the dense policy, with each call moved by jumps that do not
    know its episode.

    Args:
        plan: ``[K, blocks]``, or ``[N, K, blocks]`` for each call one of its own. It may read the rollout cache where
            the calls are windows.
    """
    loop = SparseLoop(runner, calls, None, reads=reads, whole=is_whole(plan))
    ends = loop.ends(plan) if may_jump(runner.view.manifest.spec.sample) else (loop.end(plan),)

    def missing(place: Place) -> float:
        return float((torch.cat([batch.sample for batch in place.fitted]) - calls.targets).abs().mean())

    return loop.correction(min(ends, key=missing))
