"""From which step a call may go on with the chunk of the call before: chosen on recorded episodes.

Falcon (arXiv 2503.00339) begins calls so. A call of few steps may go on with that chunk whatever it observes; so each
number of steps is also tried with the chunk of another episode, as if the world had changed between two calls.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..artifact.load import Artifact, load_artifact
from ..artifact.manifest import DENSE
from ..artifact.rest import with_last_steps
from ..artifact.settle import settle
from ..artifact.warm import WarmRecord
from ..artifact.write import locked
from ..core.coercion import integer
from ..core.spec import FloatArray, Noise
from ..core.start import Start
from ..errors import CalibrationError, CalibrationFailedError
from ..runtimes.open import open_runtime
from ..runtimes.random_calls import random_noise
from ..runtimes.runtime import Runtime
from ..trajectories.episodes import Episode
from .arguments import require_directory
from .calls import load_episodes
from .progress import Progress

LAST_STEPS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89)
"""Numbers of steps that are tried, up to half of the loop: beyond that little is saved."""
ALLOWED = 1.4
"""Distance. On three policies every number of steps below it lost nothing in 100 episodes, and the first above it lost
on one of them (``docs/howto/warm-start.md``)."""
STREAMS = 16
"""Calls that are computed together."""


@dataclass(frozen=True)
class Tried:
    """What calls of one number of steps answer; see ``WarmRecord`` for the distances."""

    last_steps: int
    same: float
    changed: float


@dataclass(frozen=True)
class WarmCalibration:
    """What was settled, and what was tried.

    Attributes:
        warm: as the artifact has it now.
        tried: from few steps to many, up to those that were settled.
    """

    warm: WarmRecord
    tried: tuple[Tried, ...]


def warm_start(
    path: str | os.PathLike[str],
    trajectories: Sequence[str | os.PathLike[str]],
    *,
    observation: Mapping[str, Sequence[str]] | None = None,
    calls: int = 512,
    max_distance: float = ALLOWED,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
) -> WarmCalibration:
    """Settle how many steps a call needs that begins with the chunk of the call before, for ``load(warm=True)``.

    The fewest are taken whose actions are not much further from those of a dense call with other noise than two dense
    calls are from each other: after the call before, and after a call of another episode, drawn at random.

    Args:
        path: the artifact's directory.
        trajectories: recorded episodes, see ``ttscompile.trajectories``, calls in order.
        observation: by key of the observation, the arrays of a recording that it is made of.
        calls: to measure, at most.
        max_distance: that is allowed; 1 is that of two dense calls. See ``WarmRecord``.
        seed: of the noise.
        progress: told what is being done, how many numbers of steps were tried, and of how many.

    Raises:
        CalibrationFailedError: no number up to half of the steps is within what is allowed. The artifact is as it was.
        CalibrationError: an argument is out of range, or there are no two episodes of two calls.
        SpecError: the sampler's table does not tell what such a call begins with.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: the artifact cannot be opened or written, or another process is changing it.
    """
    calls, seed = integer(calls, "calls", CalibrationError, 2), integer(seed, "seed", CalibrationError)
    if not max_distance > 0:
        raise CalibrationError(f"max_distance: expected a positive number; found {max_distance}.")
    require_directory(Path(path))
    with locked(Path(path)):  # what is settled is of the artifact that was measured
        artifact = load_artifact(Path(path))
        numbers = [n for n in LAST_STEPS if n <= artifact.manifest.steps // 2]
        rests = [with_last_steps(artifact, n) for n in numbers]
        if not rests:
            raise _refused(path, f"a loop of {artifact.manifest.steps} step has no half")
        measured = _Measured(artifact, load_episodes(artifact.manifest.spec, trajectories, observation), calls, seed)
        tried: list[Tried] = []
        for number, (rest, start) in enumerate(rests):
            progress("numbers of steps", number, len(rests))
            tried.append(measured.tried(rest, start))
            if max(tried[-1].same, tried[-1].changed) <= max_distance:
                break
        else:
            best = min(tried, key=lambda one: max(one.same, one.changed))
            told = f"the last {best.last_steps} give distances of {best.same:.3g} and, where the world has changed,"
            raise _refused(path, f"{told} {best.changed:.3g}, and {max_distance:g} is allowed")
        chosen = tried[-1]
        record = WarmRecord(chosen.last_steps, chosen.same, chosen.changed, float(max_distance), measured.count)
        settle(path, "warm", record, held=True)
        return WarmCalibration(record, tuple(tried))


def _refused(path: str | os.PathLike[str], why: str) -> CalibrationFailedError:
    remedy = "Nothing was settled. Calls begin with noise; ttscompile.load(DIR, warm=N) takes a number all the same"
    return CalibrationFailedError(f"{Path(path)}: a warm start is not like a dense call: {why}. {remedy}.")


class _Measured:
    """Recorded calls with what comes before them, and dense answers.

    Attributes:
        count: how many calls.
    """

    def __init__(self, artifact: Artifact, episodes: Sequence[Episode], calls: int, seed: int) -> None:
        self._spec, self._runtime = artifact.manifest.spec, open_runtime(artifact, plan=DENSE)
        self._episodes, self._places = episodes, _places(episodes, calls)
        self.count = len(self._places)
        rng = np.random.default_rng(seed)
        before, other, self._noise, beside = ([random_noise(self._spec, rng) for _ in self._places] for _ in range(4))
        own = [(i, row - 1) for i, row in self._places]
        changed = [(another(episodes, i, row, rng), row - 1) for i, row in self._places]
        dense = partial(self._samples, self._runtime, artifact, DENSE)
        self._before = dense(own, before), dense(changed, other)
        self._dense = self._executed(dense(self._places, beside))
        self._apart = self._from_dense(dense(self._places, self._noise))

    def tried(self, rest: Artifact, start: Start) -> Tried:
        """What the last steps of the loop answer."""
        runtime, distances = self._runtime.of_last_steps(rest), []
        for samples in self._before:
            noise = [
                start.noise_from(sample, self._spec.chunk, fresh)
                for sample, fresh in zip(samples, self._noise, strict=True)
            ]
            made = self._samples(runtime, rest, rest.manifest.default_plan, self._places, noise)
            distances.append(self._from_dense(made) / self._apart)
        return Tried(rest.manifest.steps, *distances)

    def _samples(
        self,
        runtime: Runtime,
        artifact: Artifact,
        plan: str,
        places: Sequence[tuple[int, int]],
        noises: Sequence[Noise],
    ) -> list[FloatArray]:
        """The denoised sample ``[1, T, D]`` of the call at each place, an episode and a row."""
        made: list[FloatArray] = []
        for begin in range(0, len(places), STREAMS):
            some, fresh = places[begin : begin + STREAMS], noises[begin : begin + STREAMS]
            obs = {
                key: one.normalized(np.stack([self._episodes[i].observations[key][row] for i, row in some]))
                for key, one in self._spec.observations.items()
            }
            steps = None if fresh[0].steps is None else np.concatenate([one.steps for one in fresh], axis=1)
            noise = Noise(np.concatenate([one.initial for one in fresh]), steps)
            runtime.reset()
            sample, _ = runtime.predict(obs, noise, artifact.schedule(plan), plan_name=plan)
            made += np.split(sample, len(some))
        return made

    def _executed(self, samples: Sequence[FloatArray]) -> npt.NDArray[np.float64]:
        chunk = self._spec.chunk
        return np.array([chunk.unnormalized(one)[0, chunk.start : chunk.stop] for one in samples], np.float64)

    def _from_dense(self, samples: Sequence[FloatArray]) -> float:
        """Mean distance of the executed actions from those of a dense call with other noise."""
        return float(np.abs(self._executed(samples) - self._dense).mean())


def _places(episodes: Sequence[Episode], calls: int) -> list[tuple[int, int]]:
    """Episode and row of calls that have one before them in two episodes at least: evenly spread, in order."""
    known = sorted((episode.calls for episode in episodes), reverse=True)
    if len(known) < 2 or known[1] < 2:
        found = f"{len(known)} episodes, of at most {known[0] if known else 0} calls"
        raise CalibrationError(f"a warm start is measured on two episodes of two calls, at least; found {found}.")
    both = [(i, row) for i, one in enumerate(episodes) for row in range(1, min(one.calls, known[1]))]
    return [both[n] for n in np.unique(np.linspace(0, len(both) - 1, min(calls, len(both))).round().astype(int))]


def another(episodes: Sequence[Episode], own: int, row: int, rng: np.random.Generator) -> int:
    """The number of another episode that has a call of this number, drawn at random."""
    return int(rng.choice([i for i, episode in enumerate(episodes) if i != own and episode.calls > row]))
