"""What everything that learns is given, and what every plan is judged on: the same for all.

One division of the recorded episodes, one source of noise, and what the original answers to the same observations.
Nobody else divides episodes, draws noise, or asks the original: so what was learned from is never judged on, and two
scores are of the same calls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from ..artifact.load import Artifact
from ..artifact.view import View, view_of
from ..core.correction import COMPONENTS, numbers_of
from ..core.envelope import Envelope
from ..core.lattice import dense_plan
from ..core.plan import DENSE, FULL, ORIGINAL, Plan
from ..core.spec import FloatArray, Noise, PolicySpec
from ..pool import Here, Pool
from ..runtimes.random_calls import Observation, noise_of_any_horizon, normalized
from ..runtimes.reference.model import noise_tensors
from ..trajectories.episodes import Episode
from .arguments import CallLimits
from .calls import FRACTION, Calls, IntArray, Split, calls_at, observed, split_episodes, window_of
from .clock import Clock
from .progress import Bar
from .regression import envelope_of
from .runner import Runner
from .state import StateFile
from .targets import LATE, dense_rounds, draw_calls, inpaints_prefixes, late_calls, with_targets

ANSWERED_BY = 0.5
"""Share of the time limit after which no more calls to learn from are answered than there have to be."""

DRAWS, MANY_DRAWS, MOST_DRAWS = 4, 16, 64
"""Of noise for each observation; the second where the artifact has further loops, with whose samplers no noise can be
paired. Where two plans answer alike the error of an energy distance falls as the number of draws, and only as the root
of that of observations. So a small network is asked more often, up to the third."""

OBSERVATIONS = 32
"""That the original answers, at most, of either part; half as many that confirm, and of what is learned from with
further loops, since only precisions and tokens are chosen on that."""

FEWEST_OBSERVATIONS = 4
"""That it answers whatever the time."""

QUICKLY, MORE_DRAWS = 0.7, 0.03
"""Share of the time for calls to learn from in which a small network answers more than usual, and of the time limit for
more draws of noise."""

RATE = 4.6e10
"""FLOPs a second of a core with AVX-512, in dense calls of a small network. How many answers fit into a time follows
from it, so that it is the same on every machine; the clock ends them where one is slower."""

EPISODES = 16
"""That these are of, at most."""

STRETCH = 32
"""Consecutive calls of an episode that they are among, at most: a plan that goes on from call to call makes all."""

LEARNED, HELD_OUT, ELSEWHERE, CONFIRMING = "learned", "held out", "elsewhere", "confirming"
"""The two parts of the episodes, to learn from and to judge on; calls of another episode before those of a part; and
further calls of the held-out episodes. A plan that was chosen among many looks nearer than it is on the calls that it
was chosen by: these confirm it."""

_NUMBERS = {LEARNED: 0, HELD_OUT: 1, ELSEWHERE: 2, CONFIRMING: 3}

JUDGING = {LEARNED: 0.15, HELD_OUT: 0.15, CONFIRMING: 0.05}
"""Share of the time limit for the answers of each part that plans are judged by. A slow policy gives fewer."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Calls of one part that the original has answered, each several times, with other noise.

    Attributes:
        stretches: number of the episode, first row and last row of each stretch of consecutive calls, ``[S, 3]``.
        calls: number of the stretch and row of each answered call, ``[N, 2]``; where its stretch is longer than one
            call there is one before it in the stretch.
        answers: denoised samples of the original, float32 ``[N, R, T, D]``; R draws of noise of each call.
    """

    part: str
    stretches: IntArray
    calls: IntArray
    answers: FloatArray

    @property
    def draws(self) -> int:
        """R."""
        return int(self.answers.shape[1])

    @property
    def episodes(self) -> IntArray:
        """The number of the episode of each answered call, ``[N]``."""
        return np.asarray(self.stretches[self.calls[:, 0], 0])


@dataclass(frozen=True, eq=False)
class Trials:
    """See the module. ``Trials.of`` makes them.

    Attributes:
        artifact: as it would be with what is judged; ``holding`` adds to it, in memory.
        split: numbers of those that are learned from, and of those that are held out.
        seed: of the split, the noise, and everything else that is random.
        base: what a calibration begins with: every cell of its loop, in its precision and with its tokens.
        runner: runs plans of the base's loop on many calls at once, in fp32.
        limits: of the number of calls to learn from.
        observations: that the original answers, at most; see ``OBSERVATIONS``.
        name: of the best plan so far.
        draws: of noise for each of them, at least.
        begun_at: seconds on the clock from which on calls to learn from are answered.
        until_share: share of the clock's limit after which no more of them are answered than there have to be.
        fresh: whether the artifact holds in memory what it has not in its files.
        state: of the calibration; what the original answers is kept there.
        device: where the network computes; None for the CPU.
        runtime: that executes what is judged, where it can.
    """

    artifact: Artifact
    episodes: Sequence[Episode]
    split: Split
    seed: int
    base: Plan
    runner: Runner
    state: StateFile
    clock: Clock = field(default_factory=Clock)
    bar: Bar = field(default_factory=partial(Bar, shown=False))
    pool: Pool = field(default_factory=Here)
    device: torch.device | None = None
    runtime: str = "onnxruntime"
    fresh: bool = False
    limits: CallLimits = field(default_factory=CallLimits)
    observations: int = OBSERVATIONS
    name: str = DENSE
    draws: int = DRAWS
    begun_at: float = 0.0
    until_share: float = ANSWERED_BY
    _calls: dict[int, Calls] = field(default_factory=dict)
    _loops: dict[str, tuple[Plan, Runner, dict[int, Calls]]] = field(default_factory=dict)
    _samples: dict[str, Sample] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        artifact: Artifact,
        episodes: Sequence[Episode],
        state: StateFile,
        *,
        seed: int = 0,
        fraction: float = FRACTION,
        **others: Any,
    ) -> Trials:
        """Divide the episodes, and open the policy; ``others`` are further fields."""
        if artifact.manifest.spec.loops:
            others |= {"draws": MANY_DRAWS}
        base = base_of(artifact)
        runner = Runner(view_of(artifact, base.exact), others.get("device"))
        split = split_episodes(len(episodes), fraction, seed)
        return cls(artifact, episodes, split, seed, base, runner, state, **others)

    def of_loop(self, loop: str) -> Trials:
        """The same episodes, noise and answers of the original; to learn from are calls of a loop."""
        self._loops.setdefault(self.base.loop, (self.base, self.runner, self._calls))
        if loop not in self._loops:
            manifest = self.artifact.manifest
            base = replace(self.base, loop=loop, cells=dense_plan(manifest.steps_of(loop), len(manifest.blocks)))
            self._loops[loop] = base, Runner(view_of(self.artifact, base.exact), self.device), {}
        base, runner, calls = self._loops[loop]
        return replace(self, base=base, runner=runner, _calls=calls)

    @property
    def calls(self) -> Calls:
        """Calls of the episodes that are learned from, and the base's way to its answer with the same noise."""
        return self._to_learn_from(1)

    @property
    def windows(self) -> Calls:
        """The same in windows of consecutive calls, for what reads what an earlier call computed."""
        return self._to_learn_from(window_of(self.episodes, self.split))

    @property
    def envelope(self) -> Envelope | None:
        """Of the observations that were learned from; None where none were, or their condition is not read."""
        if (calls := next(iter(self._calls.values()), None)) is None:
            return None
        condition = self.runner.model.condition(calls.contexts)
        most = min(COMPONENTS, numbers_of([tuple(condition.shape[1:])]))
        return envelope_of(condition, calls.episodes, most) if most else None

    def _to_learn_from(self, window: int) -> Calls:
        if window not in self._calls:
            fewest, loop = self.limits.fewest, self.base.loop
            name = ("calibration" if window == 1 else "windows") + f" of {loop}" * (loop != ORIGINAL)
            most, until = self._affordable(name), self.clock.until(self.until_share)
            inpaints = window == 1 and inpaints_prefixes(self.runner.view.manifest.spec)
            calls = draw_calls(self.runner, self.episodes, self.split, most, self.seed, window)
            first = until.until(0.8 if inpaints else 1.0)
            calls = with_targets(self.runner, name, calls, fewest, self.state, first, self.bar, self.pool)
            if inpaints and calls.count >= LATE * fewest:  # fewer do harm
                late, also = late_calls(self.runner, calls, self.seed), f"{name}, with a prefix"
                late = with_targets(self.runner, also, late, 0, self.state, until, self.bar, self.pool)
                calls = replace(calls, late=late if late.count >= fewest else None)
            self._calls[window] = calls
            if self.clock.left() < 0:
                self.bar.warn(
                    f"{self.clock.limit / 60:g} minutes were over when the calls to learn from had been answered:"
                    f" {fewest} are needed. The search is the shortest there is; allow more time."
                )
        return self._calls[window]

    def _affordable(self, name: str) -> int:
        """How many calls to learn from are drawn: as many as usual, or more of a small network."""
        found = QUICKLY * (self.until_share * self.clock.limit - self.begun_at) / _seconds(self.runner.view)
        known = name in self.state.get("targets")
        return self._settled(f"{name} drawn", found, self.limits.usual, self.limits.most, known)

    def _settled(self, key: str, found: float, usual: int, most: int, known: bool) -> int:
        """How many are asked for, as many as usual at least. It is kept, since their noise depends on it.

        ``known``: whether a state has their answers; one that has them without the number has as many as usual.
        """
        if key not in self.state.progress:
            self.state.progress[key] = usual if known else int(np.clip(found, usual, most))
        return int(self.state.progress[key])

    @property
    def changed_name(self) -> str:
        """Of the best plan so far with another field: its own, or ``full`` in place of ``dense``, which stays."""
        return FULL if self.name == DENSE else self.name

    @property
    def used(self) -> int:
        """How many calls were learned from."""
        return sum(calls.count for calls in self._calls.values())

    @property
    def learned(self) -> Sample:
        """Answered calls of the episodes that are learned from: for proposers to choose on."""
        return self.sample(LEARNED)

    @property
    def held_out(self) -> Sample:
        """Answered calls of the other episodes: no proposer reads them."""
        return self.sample(HELD_OUT)

    def sample(self, part: str) -> Sample:
        """The answered calls of a part; answered when they are first asked for."""
        if part not in self._samples:
            numbers = self.split.calibration if part == LEARNED else self.split.validation
            half = part == CONFIRMING or (part == LEARNED and bool(self.artifact.manifest.spec.loops))
            most = max(self.observations // (1 + half), 1)
            judged = self.held_out if part == CONFIRMING else None
            stretches, calls = _places(self.episodes, numbers, (self.seed, 4, _NUMBERS[part]), most, judged)
            draws = self._draws(part, len(calls))
            calls = self._in_time(part, stretches, calls, draws)
            self._samples[part] = Sample(part, stretches, calls, self._answers(part, stretches, calls, draws))
        return self._samples[part]

    def observation(self, places: Sequence[tuple[int, int]]) -> Observation:
        """Normalised observations, by key ``[n, ...]``, of calls by number of the episode and row in it."""
        spec = self.artifact.manifest.spec
        return normalized(spec, observed(spec, self.episodes, places))

    def noise(self, spec: PolicySpec, keys: Sequence[tuple[int, ...]]) -> Noise:
        """The noise of calls with these keys (``noise_key``), the same numbers for every plan.

        As many as the original's horizon has are drawn for every step, so that a loop of as many steps has the same,
        and any loop begins alike.
        """
        drawn = [noise_of_any_horizon(spec, np.random.default_rng((self.seed, 5, *key)), 1) for key in keys]
        draws = [one.steps for one in drawn if one.steps is not None]
        return Noise(np.concatenate([one.initial for one in drawn]), np.concatenate(draws, 1) if draws else None)

    def noise_key(self, part: str, stretch: int, row: int, draw: int) -> tuple[int, ...]:
        """What ``noise`` tells a call from others by."""
        return _NUMBERS[part], stretch, row, draw

    def _draws(self, part: str, calls: int) -> int:
        """Of noise for each of so many calls; as many as usual where there is no limit of time."""
        seconds, known = self.clock.limit, bool(self.state.get(f"{part} answers"))
        found = MORE_DRAWS * seconds / (calls * _seconds(view_of(self.artifact, DENSE)))
        few = known or not np.isfinite(seconds)
        return self._settled(f"{part} draws", found, self.draws, max(self.draws, MOST_DRAWS), few)

    def _in_time(self, part: str, stretches: IntArray, calls: IntArray, draws: int) -> IntArray:
        """As many of these calls as the original answers in their share of the time, evenly spread."""
        key, begun = f"{part} observations", self.clock.elapsed()
        if self.state.get(f"{part} answers"):
            self.state.progress.setdefault(key, len(calls))
        if key not in self.state.progress:
            self._answers(part, stretches, calls[:1], draws)
            took = max(self.clock.elapsed() - begun, 1e-9)
            found = min(JUDGING[part] * self.clock.limit / took, len(calls))
            self.state.progress[key] = max(int(found), min(FEWEST_OBSERVATIONS, len(calls)))
            if self.state.progress[key] < len(calls):
                self.bar.warn(
                    f"the original answers {self.state.progress[key]} of {len(calls)} {part} observations: it takes"
                    f" {took:.3g} s for each. Limits of a distance are wider so; allow more time."
                )
        count = min(int(self.state.progress[key]), len(calls))
        return calls[np.linspace(0, len(calls) - 1, count).round().astype(np.int64)]

    def _answers(self, part: str, stretches: IntArray, calls: IntArray, draws: int) -> FloatArray:
        """What the original answers, ``[N, draws, T, D]``; what is in the state already is not asked for again."""
        view = view_of(self.artifact, DENSE)
        spec = view.manifest.spec
        asked = [(int(s), int(row), draw) for s, row in calls for draw in range(draws)]
        noise = self.noise(spec, [self.noise_key(part, *one) for one in asked])
        places = [(int(stretches[s, 0]), row) for s, row, _ in asked]
        key = f"{part} answers"
        kept = self.state.get(key)
        if not np.array_equal(before := kept.get("calls", np.zeros((1, 2))), calls[: len(before)]):  # of others
            kept = {}
        known = kept.get("samples", np.zeros((0, *spec.sample), np.float32))
        with self.state.reading():
            if known.shape[1:] != spec.sample or known.dtype != np.float32 or len(known) > len(asked):
                raise ValueError(f"expected answers float32 [n, {spec.sample}]; found {known.dtype} {known.shape}")
        if len(known) < len(asked):
            runner = self.runner if self.runner.view.variant == view.variant else Runner(view, self.device)
            drawn = calls_at(runner.model, spec, self.episodes, places, noise_tensors(noise, spec.sampler.stochastic))
            self.bar.stage(f"original, {part} episodes", len(asked), len(known))
            for found in dense_rounds(runner, drawn, len(known), self.pool):
                known = np.concatenate([known, found[:, -1].numpy()])
                self.state.put(key, {"samples": known, "calls": calls})
                self.state.save(seconds=self.clock.elapsed())
                self.bar.update(len(known), "", self.clock.left())
        return known.reshape(len(calls), draws, *spec.sample)


def _seconds(view: View) -> float:
    """About what a dense call takes, if its arithmetic is all."""
    manifest = view.manifest
    return manifest.flops.call(dense_plan(manifest.steps, len(manifest.blocks)), pruned=False) / RATE


def base_of(artifact: Artifact) -> Plan:
    """What a calibration begins with: plan ``full``, or ``dense`` where there is none."""
    return artifact.plans.get(FULL, artifact.plans[DENSE])


def _places(
    episodes: Sequence[Episode], numbers: Sequence[int], seed: tuple[int, ...], most: int, but: Sample | None
) -> tuple[IntArray, IntArray]:
    """Stretches, and calls among them, as ``Sample`` has them: evenly over the episodes, at most so many calls.

    Of an episode that has half as many others at least, none of a sample.
    """
    draw = np.random.default_rng(seed)
    chosen = np.sort(draw.permutation(np.array(numbers))[: min(EPISODES, most)])
    stretches, calls = [], []
    for stretch, number in enumerate(chosen.tolist()):
        length = min(episodes[number].calls, STRETCH)
        first = int(draw.integers(episodes[number].calls - length + 1))
        last = first + length - 1
        stretches.append((number, first, last))
        count, may = most // len(chosen), np.arange(min(first + 1, last), last + 1)
        rows = np.linspace(may[0], last, count).round()
        if but is not None:
            others = np.setdiff1d(may, but.calls[but.episodes == number, 1])
            if 2 * len(others) >= count:
                rows = others[np.linspace(0, len(others) - 1, count).round().astype(np.int64)]
        calls += [(stretch, int(row)) for row in np.unique(rows)]
    return np.array(stretches, np.int64), np.array(calls, np.int64)
