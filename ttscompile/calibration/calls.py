"""The calls that calibration works on: observation, noise, and what the dense policy answers."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..core.spec import FloatArray, PolicySpec
from ..core.tokenizer import ReadTokenizer
from ..errors import CalibrationError
from ..measure.points import LARGEST
from ..runtimes.inpainting import Known
from ..runtimes.random_calls import Observation, normalized
from ..runtimes.reference.model import Contexts, ReferenceModel
from ..trajectories.episodes import Episode, episodes_of
from ..trajectories.fits import check_ranges

IntArray = npt.NDArray[np.int64]

FRACTION = 0.25
"""Share of the episodes that plans are judged on, if nothing else is asked for. Whoever splits with the seed of a
calibration judges on episodes that it saw nothing of."""


@dataclass(frozen=True)
class Split:
    """Calls by episode: what plans are learned from, and what they are judged on.

    Attributes:
        calibration: numbers of the episodes to learn from.
        validation: numbers of the episodes to judge on; none of them is in ``calibration``.
    """

    calibration: tuple[int, ...]
    validation: tuple[int, ...]


def split_episodes(count: int, fraction: float, seed: int) -> Split:
    """Divide episodes at random; at least one for validation, and at least one is left to learn from."""
    # Who draws has a number of its own beside the seed: 0 here, 1 calls, 2 their noise, 3 searches, 4 to 6 the judge.
    order = np.random.default_rng((seed, 0)).permutation(count).tolist()
    held_out = min(max(round(count * fraction), 1), count - 1)
    return Split(calibration=tuple(sorted(order[held_out:])), validation=tuple(sorted(order[:held_out])))


def load_episodes(
    spec: PolicySpec,
    trajectories: Sequence[str | os.PathLike[str]],
    observation: Mapping[str, Sequence[str]] | None,
    tokenizer: ReadTokenizer | None = None,
) -> list[Episode]:
    """The recorded episodes, as the policy observes them; see ``load_trajectories``.

    Raises:
        TrajectoryError: the recordings do not fit the policy.
    """
    episodes = episodes_of(spec, trajectories, observation, tokenizer)
    if len(episodes) < 2:
        raise CalibrationError(
            "the trajectories hold one episode; expected at least two: a plan is judged on episodes that it was not"
            " learned from. Record more; about sixteen are enough."
        )
    check_ranges(episodes, spec)
    return episodes


WINDOW = 8
"""Consecutive calls of an episode that stand together where plans may read the rollout cache; fewer in short ones."""


@dataclass(frozen=True)
class Calls:
    """N calls: independent of each other, or in windows of consecutive calls of one episode.

    The first call of a window is treated as the first of its episode: nothing of an earlier one is in the caches.

    Attributes:
        contexts: what the loop reads beside the residual stream.
        initial: the sample at step 0, ``[N, T, D]``.
        noise: the draw used at each step, ``[K, N, T, D]``; None if the sampler is deterministic.
        episodes: the number of the episode that each call is from, ``[N]``.
        path: the sample of the dense policy after each step with the same noise, ``[N, K, T, D]``; None before it is
            known. Where a prefix takes its place it is what the step makes, before that.
        window: how many calls, one after the other, are a window; 1 for calls that are independent of each other.
        known: what prefixes make known of the samples; NaN where that of a call is shorter. None without prefixes.
        late: the first of these calls once more, each with a prefix and other noise, which corrections of such calls
            are fitted on; None for none.
    """

    contexts: Contexts
    initial: Tensor
    noise: Tensor | None
    episodes: IntArray
    path: Tensor | None = None
    window: int = 1
    known: Known | None = None
    late: Calls | None = None

    @property
    def count(self) -> int:
        """N."""
        return len(self.initial)

    def parts(self, most: int) -> list[IntArray]:
        """Numbers of the calls, at most so many together; windows stay whole, however long."""
        size = max(1, most // self.window) * self.window
        return [np.arange(i, min(i + size, self.count)) for i in range(0, self.count, size)]

    @property
    def targets(self) -> Tensor:
        """The denoised sample of the dense policy, ``[N, T, D]``."""
        assert self.path is not None
        return self.path[:, -1]


def calls_of(windows: IntArray, window: int) -> IntArray:
    """Numbers of the calls of these windows, in their order."""
    return np.asarray((windows[:, None] * window + np.arange(window)).reshape(-1))


def window_of(episodes: Sequence[Episode], split: Split) -> int:
    """How many consecutive calls are a window: ``WINDOW``, or the most that an episode of either part has."""
    longest = (max(episodes[n].calls for n in part) for part in (split.calibration, split.validation))
    return min(WINDOW, *longest)


def sample_calls(
    episodes: Sequence[Episode], numbers: Sequence[int], limit: int, seed: int, repeats: int = 1, window: int = 1
) -> list[tuple[int, int]]:
    """At most ``limit`` calls, drawn at random from some episodes: number of the episode, and row in it.

    Args:
        repeats: how often a call may be drawn (it will have another noise each time), after all the others were.
        window: consecutive calls that are drawn together, and stand one after the other. The windows of an episode do
            not overlap, and cover it from its first call on; calls that are left over at its end are not drawn.
    """
    draw = np.random.default_rng((seed, 1, *numbers))
    places = [(n, row) for n in numbers for row in range(0, episodes[n].calls - window + 1, window)]
    order = np.concatenate([draw.permutation(len(places)) for _ in range(repeats)])
    chosen = [places[i] for i in order[: max(1, limit // window)]]
    return [(n, row + i) for n, row in chosen for i in range(window)]


OBSERVED_AT_ONCE = 64
"""Observations that go through the prologue together: a few thousand with images would be more than the memory."""


def prepare_calls(
    model: ReferenceModel,
    spec: PolicySpec,
    episodes: Sequence[Episode],
    chosen: Sequence[tuple[int, int]],
    seed: tuple[int, ...],
    window: int = 1,
) -> Calls:
    """Calls without targets: draw their noise and run the prologue. See ``calls_at``."""
    return calls_at(model, spec, episodes, chosen, draw_noise(spec, len(chosen), seed), window)


def calls_at(
    model: ReferenceModel,
    spec: PolicySpec,
    episodes: Sequence[Episode],
    chosen: Sequence[tuple[int, int]],
    noise: tuple[Tensor, Tensor | None],
    window: int = 1,
) -> Calls:
    """Calls without targets: runs the prologue.

    Args:
        spec: of the policy, with the loop of the model.
        chosen: the number of the episode, and the row in it, of each call; those of a window one after the other.
        noise: initial samples ``[N, T, D]``, and draws ``[K, N, T, D]`` or None.
    """

    def parts() -> Iterator[Contexts]:
        for begin in range(0, len(chosen), OBSERVED_AT_ONCE):
            seen = normalized(spec, observed(spec, episodes, chosen[begin : begin + OBSERVED_AT_ONCE]))
            yield model.prologue({key: torch.from_numpy(one) for key, one in seen.items()})

    with torch.no_grad():
        contexts = model.joined(parts(), len(chosen))
    return Calls(contexts, *noise, np.array([n for n, _ in chosen], np.int64), window=window)


def observed(spec: PolicySpec, episodes: Sequence[Episode], chosen: Sequence[tuple[int, int]]) -> Observation:
    """What was observed at some calls, by key ``[n, ...]``, as it was recorded."""
    return {key: np.stack([episodes[n].observations[key][row] for n, row in chosen]) for key in spec.observations}


def draw_noise(spec: PolicySpec, count: int, seed: tuple[int, ...]) -> tuple[Tensor, Tensor | None]:
    """``initial`` and ``noise`` of so many ``Calls``."""
    draw = np.random.default_rng(seed)
    shape = (count, *spec.sample)
    initial = torch.from_numpy(spec.draw_initial(draw, shape))
    if not spec.sampler.stochastic:
        return initial, None
    return initial, torch.from_numpy(draw.standard_normal((spec.sampler.steps, *shape), dtype=np.float32))


class Actions:
    """Finds what is executed of denoised samples, and how far two of them are apart."""

    def __init__(self, spec: PolicySpec) -> None:
        self._chunk = spec.chunk
        self._scale = torch.from_numpy(np.array(spec.chunk.scale))

    def executed(self, samples: Tensor) -> Tensor:
        """The executed part of samples ``[..., T, D]`` as ``[..., Ta Da]``, as the network has it: normalised."""
        return torch.as_tensor(self._chunk.executed(samples)).flatten(-2)

    def errors(self, samples: Tensor, targets: Tensor, units: bool) -> FloatArray:
        """Mean absolute difference of the executed actions of each call; at most ``LARGEST``, also where they are NaN.

        Args:
            samples: ``[..., N, T, D]``.
            targets: ``[N, T, D]``.
            units: in the units of the actions, rather than normalised.

        Returns:
            ``[..., N]``.
        """
        difference = (self.executed(samples) - self.executed(targets)).abs()
        if units:
            numbers = (*difference.shape[:-1], -1, self._chunk.action_dim)
            difference = (difference.reshape(numbers) / self._scale).flatten(-2)
        return np.asarray(difference.mean(-1).nan_to_num(nan=LARGEST).clamp(max=LARGEST).numpy(), dtype=np.float32)


def digest_of(episodes: Sequence[Episode]) -> str:
    """What tells one set of recordings from another."""
    digest = hashlib.sha256()
    for episode in episodes:
        for key, array in sorted(episode.observations.items()):
            digest.update(f"{key} {array.dtype} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
