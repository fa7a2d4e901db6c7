"""How far what a plan answers is from what the original answers: the one yardstick for plans of every kind.

The energy distance (Szekely and Rizzo, 2013) of the executed actions, normalised, with their root mean square as norm.
For draws i < j of noise of one observation, with x the plan's answers and y the original's,

    h = |x_i - y_j| + |x_j - y_i| - |x_i - x_j| - |y_i - y_j|

has the energy distance of the two distributions of answers as its mean, whether or not draw i of the plan has the noise
of draw i of the original, as long as it shares none with another draw. Where it has, x_i is near y_i, the terms nearly
cancel, and h varies little. ``distance`` is the root of the mean of h over the mean of |y_i - y_j|: 0 where nothing can
be told apart; the root grows as the error does. ``docs/decisions.md`` has the measurements behind norm and root. Where
noise changes nothing the unit is another one (``measure.points.pairs``).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import torch

from ..artifact.view import view_of
from ..core.lattice import Source, plan_flops, sparsity
from ..core.plan import ORIGINAL, Plan
from ..core.spec import FloatArray, PolicySpec
from ..errors import CalibrationError
from ..measure.points import LARGEST, SAME, Gaps, Numbers, signed_root
from ..measure.timer import Timer, Times
from ..runtimes.open import open_runtime
from ..runtimes.report import CallReport
from ..runtimes.runtime import Runtime
from .trials import ELSEWHERE, HELD_OUT, Sample, Trials

STREAMS = 32
"""Calls that are computed together, at most."""

WARM_UP, TIMED = 2, 16
"""Rounds of timed calls that are not counted, and that are."""


@dataclass(frozen=True)
class Score:
    """How good a plan is on calls of one part of the episodes.

    Attributes:
        distance: between what it answers and what the original answers to the same observation, in units of what other
            noise changes; 0 is the same. See the module.
        interval: 95 % interval of the distance, for other calls and episodes.
        error: mean absolute difference between its executed actions and those of the original with the same noise, in
            the units of the actions; None for plans of another sampler or start, which take other noise.
        error_p90: 90th percentile of that over calls.
        sparsity: share of the cells that are reused, mean over the calls.
        flops_sparsity: the same with each cell weighed by its FLOPs.
        flops_saved: share of the FLOPs of a dense call of the original that are saved; all that is computed is counted.
        plans: how many different matrices of cells the calls had.
        tokens: share of the tokens of new frames that were computed; 1 where no tokens are reused.
        outside: see ``MeasuredPoint``.
        gaps: what ``further`` compares.
        answers: what it executes, normalised, ``[N, R, Ta, Da]``.
    """

    distance: float
    interval: tuple[float, float]
    error: float | None
    error_p90: float | None
    sparsity: float
    flops_sparsity: float
    flops_saved: float
    plans: int
    tokens: float = 1.0
    outside: tuple[float, ...] = ()
    gaps: Gaps | None = field(default=None, compare=False, repr=False)
    answers: Numbers | None = field(default=None, compare=False, repr=False)

    def record(self) -> dict[str, Any]:
        """As JSON, for the record of a calibration; the same on every machine."""
        left = "outside", "gaps", "answers"
        return {name: one for name, one in vars(self).items() if one is not None and name not in left}


def judge(trials: Trials, plan: Plan, part: str = HELD_OUT) -> Score:
    """Score a plan.

    A plan that begins with the chunk of the call before is judged along each stretch of an episode, and once more with
    the chunk of another episode, as if the world had changed between two calls; the worse of the two counts.

    Raises:
        IllegalPlanError: the plan names what the artifact lacks.
        CalibrationError: a plan that begins with the chunk of the call before, and no recorded call has one before it.
    """
    plan, sample = replace(plan, repair=True), trials.sample(part)
    begun, answered = trials.clock.elapsed(), _Answers(trials, plan, sample)
    scores = [_scored(trials, plan, sample, made, answered.reports) for made in answered.all()]
    took, alone = trials.clock.elapsed() - begun, len(sample.calls) * sample.draws * call_seconds(trials, plan)
    if alone:
        paces, lowered = trials.clock.paces, bool(plan.precision)
        paces[lowered] = max(paces.get(lowered, 0.0), took / alone)
    return max(scores, key=lambda one: one.distance)


def seconds_to_judge(trials: Trials, plan: Plan, part: str = HELD_OUT, lowered: bool = False) -> float:
    """What ``judge`` takes, by what it has taken at most; ``lowered``: of the plan in another precision."""
    sample, pace = trials.sample(part), trials.clock.paces.get(lowered or bool(plan.precision), 1.0)
    return pace * len(sample.calls) * sample.draws * call_seconds(trials, plan)


def call_seconds(trials: Trials, plan: Plan) -> float:
    """What a call takes alone, by what was measured of its loop (``proposers.loops``); 0 where nothing was."""
    one, step = trials.state.progress.get("costs", {}).get(plan.loop, (0.0, 0.0))
    steps = 1 if plan.cells is None else int((plan.cells == Source.COMPUTE).any(-1).sum())
    return float(one + (steps - 1) * step) / 1e3


def further(score: Score, other: Score) -> tuple[float, float]:
    """By how much a score is further from the original than another of the same calls, and the upper 95 % limit."""
    difference, own, theirs = score.distance - other.distance, score.gaps, other.gaps
    assert own is not None and theirs is not None
    clustered = replace(own, h=own.h - theirs.h).clustered
    if len(own.h) == 1:
        return difference, float("inf")
    # No distance is below 0, though its estimate may be: that counts as 0, else what is near seems far from it.
    apart = signed_root(own.resampled(clustered)) - signed_root(theirs.resampled(clustered)).clip(0)
    return difference, float(np.quantile(apart, 0.975))


def timed(entrants: Sequence[tuple[Trials, Plan]], threads: int, rounds: int = TIMED) -> list[Times]:
    """What calls of plans take, of one stream, in turn: whatever else the machine does hits all.

    Every call computes all of its frames. One that reuses tokens computes what changed since the call before, and once
    all of it, so that the longest is known. Weights that are in memory alone are timed as the original's. All trials
    are of the same episodes.
    """
    filed = [(trials, _filed(trials, plan)) for trials, plan in entrants]
    opened = [open_runtime(one.artifact, one.runtime, threads, _device(one), plan) for one, plan in filed]
    timer, sample = Timer(len(filed), WARM_UP), entrants[0][0].held_out
    for number in range(WARM_UP + rounds):
        stretch, row = sample.calls[number % len(sample.calls)].tolist()
        for i in timer.round():
            (trials, plan), runtime = filed[i], opened[i]
            obs = trials.observation([(int(sample.stretches[stretch, 0]), row)])
            noise = trials.noise(_loop_spec(trials, plan), [trials.noise_key(sample.part, stretch, row, 0)])
            if plan.otherwise is not None:
                runtime.predict(obs, noise, plan)  # so that there is a chunk to begin with
            runtime.forget_frames()
            if plan.tokens is not None and row and number != WARM_UP:  # once all tokens are computed
                runtime.frames.values(trials.observation([(int(sample.stretches[stretch, 0]), row - 1)]))
            timer.time(i, partial(runtime.predict, obs, noise, plan))
            runtime.reset()
    return timer.times


def _device(trials: Trials) -> str | None:
    """Where its runtime computes: onnxruntime on the CPU, whatever the device of what is learned."""
    return str(trials.device) if trials.runtime == "torch" and trials.device is not None else None


def _filed(trials: Trials, plan: Plan) -> Plan:
    """The plan with weights that the artifact has in files."""
    if not trials.fresh:
        return plan
    otherwise = None if plan.otherwise is None else _filed(trials, plan.otherwise)
    return replace(plan, weights=ORIGINAL, otherwise=otherwise)


def _loop_spec(trials: Trials, plan: Plan) -> PolicySpec:
    """The specification with the whole loop that the noise of a plan's calls is for."""
    return view_of(trials.artifact, plan.otherwise or plan).manifest.spec


def other_noise(trials: Trials) -> float:
    """How far two answers of the original to one observation are apart, in the actions' units; 0 if it is rounding."""
    part = _in_units(trials)
    apart = float(np.mean([np.abs(part[:, i] - part[:, j]) for i, j in combinations(range(part.shape[1]), 2)]))
    return apart if apart > SAME * other_observations(trials) else 0.0


def other_observations(trials: Trials) -> float:
    """The same of two answers to different held-out observations; 0 where there is one alone."""
    part = _in_units(trials)
    return float(np.mean([np.abs(part - np.roll(part, n, 0)).mean() for n in range(1, len(part))] or [0.0]))


def _in_units(trials: Trials) -> Numbers:
    """What the original executes, ``[N, R, Ta, Da]``."""
    chunk = trials.artifact.manifest.spec.chunk
    return np.asarray(chunk.executed(trials.held_out.answers.astype(np.float64)) / chunk.scale)


class _Answers:
    """What a plan answers to the calls of a sample.

    Attributes:
        reports: of the calls that are scored, with the number of their stream each.
    """

    def __init__(self, trials: Trials, plan: Plan, sample: Sample) -> None:
        self._trials, self._sample = trials, sample
        self._plan = plan.exact if trials.fresh else plan
        self._spec = _loop_spec(trials, self._plan)
        name, device = trials.runtime, _device(trials)
        if trials.fresh:  # what is judged is in no file yet
            name, device = "reference", None
        elif trials.device is not None and self._plan is self._plan.exact:
            name, device = "torch", str(trials.device)
        threads = 1 if name == "reference" else torch.get_num_threads()
        self._runtime: Runtime = open_runtime(trials.artifact, name, threads, device, self._plan)
        # The scale of int8 activations is that of the whole batch, and a robot has one stream.
        self._streams = 1 if self._plan.precision else STREAMS
        self.reports: list[tuple[CallReport, int]] = []

    def all(self) -> Iterator[FloatArray]:
        """Denoised samples ``[N, R, T, D]``; twice for a plan that begins with the chunk of the call before."""
        sample, plan = self._sample, self._plan
        in_order = [(number, first, last) for number, (_, first, last) in enumerate(sample.stretches.tolist())]
        apart = [(stretch, row, row) for stretch, row in sample.calls.tolist()]
        if plan.otherwise is not None:
            if any(first == last for _, first, last in in_order):
                told = "a plan that begins with the chunk of the call before is judged on episodes of two calls at"
                raise CalibrationError(f"{told} least; one that was recorded has one call. Record longer ones.")
            yield self._along(in_order)
            yield self._along(apart, after_another=True)
        else:
            # Whether what a call of it answers depends on the calls before.
            goes_on = plan.tokens is not None or plan.cells is None or bool((plan.cells == Source.ROLLOUT).any())
            yield self._along(in_order if goes_on else apart)

    def _call_elsewhere(self, some: Sequence[tuple[int, int]], random: np.random.Generator) -> None:
        """A call of another episode before each of these calls, by number and draw of noise."""
        sample, trials, others = self._sample, self._trials, list[tuple[int, int]]()
        for n, _ in some:
            other = int(random.choice([i for i in range(len(trials.episodes)) if i != int(sample.episodes[n])]))
            others.append((other, min(int(sample.calls[n, 1]) - 1, trials.episodes[other].calls - 1)))
        keys = [trials.noise_key(ELSEWHERE, n, row, r) for (n, r), (_, row) in zip(some, others, strict=True)]
        self._runtime.predict(trials.observation(others), trials.noise(self._spec, keys), self._plan)

    def _along(self, runs: Sequence[tuple[int, int, int]], after_another: bool = False) -> FloatArray:
        """The answers along runs of consecutive calls: of each its stretch, its first row and its last.

        Several runs are the streams of a batch. A run's first call is the first of an episode, or comes after one of
        another, drawn at random: as if the world had changed.
        """
        sample, random = self._sample, np.random.default_rng((self._trials.seed, 6))
        made = np.empty((len(sample.calls), sample.draws, *self._spec.sample), np.float32)
        numbers = {(stretch, row): n for n, (stretch, row) in enumerate(sample.calls.tolist())}
        asked = [(*run, draw) for run in runs for draw in range(sample.draws)]
        for some in (asked[i : i + self._streams] for i in range(0, len(asked), self._streams)):
            self._runtime.reset()
            if after_another:
                self._call_elsewhere([(numbers[stretch, row], draw) for stretch, row, _, draw in some], random)
            for step in range(max(last - first for _, first, last, _ in some) + 1):
                # A run that is over goes on with its last call, whose answer nobody reads.
                calls = [(stretch, min(first + step, last), draw) for stretch, first, last, draw in some]
                going = [i for i, (_, first, last, _) in enumerate(some) if first + step <= last]
                wanted = [i for i in going if calls[i][:2] in numbers]
                found = self._call(calls, wanted)
                for i in wanted:
                    made[numbers[calls[i][:2]], calls[i][2]] = found[i]
        return made

    def _call(self, calls: Sequence[tuple[int, int, int]], scored: Sequence[int]) -> FloatArray:
        """The next call of streams: the stretch, row and draw of each. Reports are kept of those that are scored."""
        trials, sample = self._trials, self._sample
        obs = trials.observation([(int(sample.stretches[stretch, 0]), row) for stretch, row, _ in calls])
        noise = trials.noise(self._spec, [trials.noise_key(sample.part, *call) for call in calls])
        found, report = self._runtime.predict(obs, noise, self._plan)
        self.reports += [(report, i) for i in scored]
        return found


def _scored(
    trials: Trials, plan: Plan, sample: Sample, made: FloatArray, reports: Sequence[tuple[CallReport, int]]
) -> Score:
    spec, flops, answers = trials.artifact.manifest.spec, trials.artifact.manifest.flops, sample.answers
    x, y = (spec.chunk.executed(one).astype(np.float64).reshape(*one.shape[:2], -1) for one in (made, answers))
    x = np.nan_to_num(x, nan=LARGEST, posinf=LARGEST, neginf=-LARGEST).clip(-LARGEST, LARGEST)
    gaps = Gaps.of(x, y, sample.episodes)
    error = error_p90 = None
    original = trials.runner.view.artifact.manifest.spec.sampler
    if plan.otherwise is None and trials.artifact.manifest.sampler_of(plan.loop).takes_noise_as(original):
        wrong = np.abs(x - y).reshape(*x.shape[:2], -1, spec.chunk.action_dim) / spec.chunk.scale
        each = wrong.mean((2, 3)).clip(max=LARGEST)
        error, error_p90 = float(each.mean()), float(np.quantile(each, 0.9))
    cells = np.stack([report.plan[i] for report, i in reports])
    frames = [report.frames for report, _ in reports]
    of = sum(one.of for one in frames)
    outside = [report.outside[i] for report, i in reports if report.outside]
    block_flops = cells.shape[1] * sum(flops.blocks)
    computed = float(np.mean([plan_flops(one, flops.blocks) for one in cells]))
    return Score(
        distance=gaps.distance,
        interval=gaps.interval,
        error=error,
        error_p90=error_p90,
        sparsity=sparsity(cells),
        flops_sparsity=1 - computed / block_flops if block_flops else 0.0,
        flops_saved=1 - float(np.mean([report.flops[i] for report, i in reports])) / flops.dense,
        plans=len(np.unique(cells, axis=0)),
        tokens=sum(one.tokens for one in frames) / of if of else 1.0,
        outside=tuple(np.quantile(outside, (0.5, 0.9, 1.0)).tolist()) if outside else (),
        gaps=gaps,
        answers=x.reshape(*x.shape[:2], -1, spec.chunk.action_dim),
    )
