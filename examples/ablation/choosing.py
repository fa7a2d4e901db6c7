"""What deciding call by call could gain, from the errors of some schedules on some calls, each with several noises.

Errors are ``[O, R, S]``: of O observations with R draws of noise each, under S schedules. Whoever decides may know

- nothing: one schedule for all calls;
- everything, after the fact: the best schedule of each call, with its noise. Nobody can know that much before a call;
- the observation, after the fact: the schedule that is best on half of the draws is judged on the other half, so that
  luck of the draw is not taken for knowledge;
- some numbers that are known before the loop or after its first step: a ridge regression of the errors on them, learned
  on calls of other episodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

COMPONENTS = 64
"""Principal components of what a predictor reads, at most."""

RIDGES = (1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
"""Of the regression, for each call and number of mean square 1; chosen on episodes that it was not fitted on."""

SMALLEST = 1e-12
"""Added to errors before their logarithm is taken."""

RESAMPLED = 1000
"""Samples of the bootstrap over observations."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of schedules on calls, and what is known of the calls.

    Attributes:
        of: ``[O, R, S]``, in the units of the actions.
        episodes: of each observation, ``[O]``.
        known: by name, what a predictor may read: ``[O, R, N]``.
    """

    of: Array
    episodes: npt.NDArray[np.int64]
    known: Mapping[str, Array]


@dataclass(frozen=True)
class Choice:
    """One way of choosing a schedule for each call.

    Attributes:
        name: what is known when it is chosen.
        error: mean over the calls.
        gain: share of the best single schedule's error that is saved; negative if it is worse.
        interval: 95 % interval of the gain, over observations.
        steps: computed steps, mean over the calls.
    """

    name: str
    error: float
    gain: float
    interval: tuple[float, float]
    steps: float


SINGLE = "nothing: one schedule for all calls"
AFTER = "everything, after the fact"
OBSERVATION = "the observation, after the fact"


def choices(learned: Errors, judged: Errors, steps: npt.NDArray[np.int64], budget: int, seed: int) -> list[Choice]:
    """Ways of choosing among the schedules that compute ``budget`` steps; and among all of them, so many on average."""
    same = np.flatnonzero(steps == budget)
    one = same[learned.of[..., same].mean((0, 1)).argmin()]
    single = judged.of[..., one]
    draw = np.random.default_rng((seed, 6))
    samples = draw.integers(0, len(single), (RESAMPLED, len(single)))

    def row(name: str, errors: Array, computed: Array | float) -> Choice:
        by_observation, base = errors.mean(1), single.mean(1)
        gains = 1 - by_observation[samples].mean(1) / base[samples].mean(1)
        low, high = np.quantile(gains, (0.025, 0.975))
        gain = float(1 - by_observation.mean() / base.mean())
        return Choice(name, float(errors.mean()), gain, (float(low), float(high)), float(np.mean(computed)))

    def chosen(name: str, schedules: npt.NDArray[np.int64]) -> Choice:
        return row(name, np.take_along_axis(judged.of, schedules[..., None], 2)[..., 0], steps[schedules].astype(float))

    several = [*learned.known, *(["all of these"] if len(learned.known) > 1 else [])]
    rows = [row(SINGLE, single, budget)]
    rows.append(chosen(AFTER, same[judged.of[..., same].argmin(2)]))
    rows.append(row(OBSERVATION, _by_observation(judged.of[..., same]), budget))
    for name in several:
        predicted = _predicted(learned, judged, name, relative=True)[1]
        rows.append(chosen(name, same[predicted[..., same].argmin(2)]))
    if len(np.unique(steps)) > 1:
        rows.append(chosen(f"{AFTER}; {budget} steps on average", _on_average(judged.of, judged.of, steps, budget)))
        own, other = _predicted(learned, judged, several[-1], relative=False)
        rows.append(chosen(f"{several[-1]}; {budget} steps on average", _on_average(own, other, steps, budget)))
    return rows


def _by_observation(errors: Array) -> Array:
    """Errors ``[O, R]`` of schedules chosen for each observation, on draws that they were not chosen on."""
    found = np.empty(errors.shape[:2])
    halves = np.arange(errors.shape[1]) % 2 == 0
    for half in (halves, ~halves):
        best = errors[:, half].mean(1).argmin(1)
        found[:, ~half] = np.take_along_axis(errors[:, ~half], best[:, None, None], 2)[..., 0]
    return found


def _on_average(known: Array, guessed: Array, steps: npt.NDArray[np.int64], budget: int) -> npt.NDArray[np.int64]:
    """Schedules for calls ``[O, R]`` by guessed errors, with a price for a computed step.

    With this price calls of the ``known`` errors compute at most ``budget`` steps on average, others about as many.
    """
    low, high = 0.0, float(np.ptp(known)) + 1.0
    for _ in range(60):
        price = (low + high) / 2
        if steps[(known + price * steps).argmin(2)].mean() > budget:
            low = price
        else:
            high = price
    return np.asarray((guessed + high * steps).argmin(2))


def _predicted(learned: Errors, judged: Errors, name: str, relative: bool) -> tuple[Array, Array]:
    """Errors as a ridge regression on known numbers sees them, ``[O, R, S]``: of the calls learned on, and the others.

    Args:
        name: what it reads; any name that ``known`` does not have stands for all.
        relative: regress logarithms of errors relative to the call's mean; else errors.
    """
    names = [name] if name in learned.known else list(learned.known)
    raw = [np.concatenate([_rows(each.known[n]) for n in names], 1) for each in (learned, judged)]
    read, other = _components(*raw)
    targets = _rows(learned.of)
    if relative:
        targets = np.log(targets + SMALLEST)
        targets = targets - targets.mean(1, keepdims=True)
    episodes = np.repeat(learned.episodes, learned.of.shape[1])
    ridge = min(RIDGES, key=lambda one: _left_out(read, targets, episodes, one))
    weights = _ridge(read, targets, ridge)
    made = [np.hstack([x, np.ones((len(x), 1))]) @ weights for x in (read, other)]
    return made[0].reshape(learned.of.shape), made[1].reshape(judged.of.shape)


def _rows(array: Array) -> Array:
    return array.reshape(-1, array.shape[-1])


def _components(read: Array, other: Array) -> tuple[Array, Array]:
    """The largest principal components of what is read, of mean square 1."""
    mean, deviation = read.mean(0), read.std(0)
    scale = np.where(deviation > 1e-6 * max(float(deviation.max()), 1e-30), 1 / np.maximum(deviation, 1e-30), 0.0)
    whole = [(x - mean) * scale for x in (read, other)]
    _, lengths, directions = np.linalg.svd(whole[0], full_matrices=False)
    lengths = lengths / len(read) ** 0.5
    kept = np.flatnonzero(lengths > 1e-3 * max(float(lengths[0]), 1e-30))[:COMPONENTS]
    reading = directions[kept].T / lengths[kept]
    return whole[0] @ reading, whole[1] @ reading


def _ridge(read: Array, targets: Array, ridge: float) -> Array:
    """Weights ``[F + 1, S]``, the last row of which is the mean."""
    mean, offset = read.mean(0), targets.mean(0)
    x, y = read - mean, targets - offset
    weights = np.linalg.solve(x.T @ x + ridge * len(x) * np.eye(x.shape[1]), x.T @ y)
    return np.vstack([weights, offset - mean @ weights])


def _left_out(read: Array, targets: Array, episodes: npt.NDArray[np.int64], ridge: float) -> float:
    """Mean squared error on episodes that the regression did not see; of one episode the largest is best."""
    found = []
    for fold in range(4):
        out = np.isin(episodes, np.unique(episodes)[fold::4])
        if out.any() and not out.all():
            weights = _ridge(read[~out], targets[~out], ridge)
            found.append(np.mean((np.hstack([read[out], np.ones((int(out.sum()), 1))]) @ weights - targets[out]) ** 2))
    return float(np.mean(found)) if found else -ridge
