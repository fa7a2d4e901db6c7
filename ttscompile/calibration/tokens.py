"""When a token of an image encoder is computed: chosen on recorded episodes, and judged by the actions on others."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..artifact.load import Artifact, load_artifact
from ..artifact.settle import settle
from ..artifact.tokens import ReuseRecord
from ..artifact.write import locked
from ..core.coercion import integer
from ..core.spec import Noise
from ..errors import CalibrationError, CalibrationFailedError
from ..runtimes.against_fp32 import SHARE
from ..runtimes.frames import FrameWork
from ..runtimes.load import open_policy
from ..runtimes.random_calls import random_noise
from ..trajectories.episodes import Episode
from .arguments import require_directory
from .calls import load_episodes, split_episodes
from .progress import Progress

THRESHOLDS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)
"""Differences that are tried, ascending. Encoders read pixels with a deviation of about one."""
REFRESHES = (64, 16, 12, 8, 4)
"""Of so many new frames one is whole."""
MOST_COMPUTED = 0.75
"""Share of the tokens: where more are computed, looking for changes costs about what it saves."""
FRACTION = 0.5
"""Of the episodes, that settings are judged on."""


@dataclass(frozen=True)
class TokenCalibration:
    """What was settled, and what it takes.

    Attributes:
        reuse: as the artifact has it now.
        frame_ms: of a new frame, with all tokens, and with those that are computed.
    """

    reuse: ReuseRecord
    frame_ms: tuple[float, float]


def reuse_tokens(
    path: str | os.PathLike[str],
    trajectories: Sequence[str | os.PathLike[str]],
    *,
    observation: Mapping[str, Sequence[str]] | None = None,
    calls: int = 256,
    max_action_error: float | None = None,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
) -> TokenCalibration:
    """Have an artifact compute, of new frames, the tokens whose patches changed.

    Thresholds and refreshes are tried on half of the episodes. Actions, with the artifact's default plan and the same
    noise, have to differ by no more than is allowed, with two standard errors over episodes to spare: the best of many
    settings is otherwise one that was lucky. Of these the one with the fewest tokens is judged on the other half.

    Args:
        path: the artifact's directory.
        trajectories: recorded episodes, see ``ttscompile.trajectories``, calls in order.
        observation: by key of the observation, the arrays of a recording that it is made of.
        calls: to choose on, and as many to judge on, at most.
        max_action_error: mean difference of the executed actions, in their units, that is allowed; None for a tenth
            of what other noise changes.
        seed: of the division of the episodes and of the noise.
        progress: told what is being done, how many settings were tried, and of how many.

    Raises:
        CalibrationFailedError: no setting is within what is allowed and saves a quarter of the tokens. The artifact is
            as it was.
        CalibrationError: the artifact has no encoder with tokens, or an argument is out of range.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: the artifact cannot be opened or written, or another process is changing it.
    """
    calls, seed = integer(calls, "calls", CalibrationError, 2), integer(seed, "seed", CalibrationError)
    if max_action_error is not None and not max_action_error > 0:
        raise CalibrationError(f"max_action_error: expected a positive number; found {max_action_error}.")
    require_directory(Path(path))
    with locked(Path(path)):  # what is settled is of the artifact that was measured
        artifact = load_artifact(Path(path)).with_reuse(None)
        if not artifact.manifest.tokens:
            problem = f"{path}: no image encoder of this policy is a vision transformer, whose tokens could be reused"
            raise CalibrationError(f"{problem}. 'ttscompile convert --explain' says of each encoder why.")
        episodes = load_episodes(artifact.manifest.spec, trajectories, observation)
        split = split_episodes(len(episodes), FRACTION, seed)
        learned, judged = (
            _Recorded(artifact, [episodes[i] for i in numbers], calls, (seed, part))
            for part, numbers in enumerate((split.calibration, split.validation))
        )
        allowed = SHARE * learned.other_noise if max_action_error is None else float(max_action_error)
        found: list[_Tried] = []
        for number, refresh in enumerate(REFRESHES):
            for more, threshold in enumerate(THRESHOLDS):
                progress("settings", number * len(THRESHOLDS) + more, len(REFRESHES) * len(THRESHOLDS))
                found.append(learned.tried(ReuseRecord(threshold, refresh, 1.0, 0.0, 0.0, 1)))
                if found[-1].error > allowed:
                    break  # a larger threshold changes more
        good = [one for one in found if one.bound <= allowed]
        if not good:
            told = f"{min(one.bound for one in found):.4g} at least, two standard errors counted"
            raise _refused(path, f"the actions differ by {told}, and {allowed:.4g} is allowed")
        best = min(good, key=lambda one: (one.computed, one.error))
        progress("held-out episodes", 0, 1)
        held = judged.tried(best.reuse)
        if held.error > allowed:
            raise _refused(
                path, f"on held-out episodes actions differ by {held.error:.4g}, and {allowed:.4g} is allowed"
            )
        if held.computed > MOST_COMPUTED:
            raise _refused(path, f"{held.computed:.0%} of the tokens would be computed all the same")
        reuse = replace(
            best.reuse, computed=held.computed, error=held.error, other_noise=judged.other_noise, calls=judged.count
        )
        settle(path, "reuse", reuse, held=True)
        return TokenCalibration(reuse, (judged.frame_ms, held.frame_ms))


def _refused(path: str | os.PathLike[str], why: str) -> CalibrationFailedError:
    remedy = "It computes all tokens, as before. Record with a camera that stands still, or allow a larger error."
    return CalibrationFailedError(f"{Path(path)}: reusing tokens does not pay: {why}. {remedy}")


def with_spread(errors: npt.NDArray[np.float64], episodes: npt.NDArray[np.intp]) -> tuple[float, float]:
    """The mean of the calls' errors ``[N]``, and that with two standard errors over the calls' episodes ``[N]``."""
    each = np.array([errors[episodes == one].mean() for one in np.unique(episodes)])
    spread = float(each.std(ddof=1)) / len(each) ** 0.5 if len(each) > 1 else 0.0
    return float(errors.mean()), float(errors.mean()) + 2 * spread


@dataclass(frozen=True)
class _Tried:
    """What a setting does; ``bound`` is the error with two standard errors over episodes."""

    reuse: ReuseRecord
    computed: float
    error: float
    bound: float
    frame_ms: float


class _Recorded:
    """Recorded calls, and what the policy answers with all tokens.

    Attributes:
        count: of the calls.
        other_noise: mean difference of the executed actions from those with other noise.
        frame_ms: of a new frame, with all tokens.
    """

    def __init__(self, artifact: Artifact, episodes: Sequence[Episode], calls: int, seed: tuple[int, ...]) -> None:
        self._artifact, spec = artifact, artifact.manifest.spec
        places = ((i, row) for i, episode in enumerate(episodes) for row in range(episode.calls))
        chosen = list(islice(places, calls))
        self._calls = [(episodes[i], row) for i, row in chosen]
        self._episodes = np.array([i for i, _ in chosen])
        self.count = len(self._calls)
        rng = np.random.default_rng(seed)
        self._noise, others = ([random_noise(spec, rng) for _ in self._calls] for _ in range(2))
        self._exact, work = self._answers(artifact, self._noise)
        self.other_noise = float(np.abs(self._answers(artifact, others)[0] - self._exact).mean())
        self.frame_ms = work.waited / max(work.computed, 1)

    def tried(self, reuse: ReuseRecord) -> _Tried:
        """What a setting does."""
        made, work = self._answers(self._artifact.with_reuse(reuse), self._noise)
        error, bound = with_spread(np.abs(made - self._exact).mean(axis=tuple(range(1, made.ndim))), self._episodes)
        share, frame_ms = work.tokens / max(work.of, 1), work.waited / max(work.computed, 1)
        return _Tried(reuse, share, error, bound, frame_ms)

    def _answers(self, artifact: Artifact, noise: Sequence[Noise]) -> tuple[npt.NDArray[np.float64], FrameWork]:
        """The executed actions ``[N, Ta, Da]``, and what frames took."""
        policy, work, before = open_policy(artifact), FrameWork(), None
        actions = []
        for (episode, row), each in zip(self._calls, noise, strict=True):
            if episode is not before:
                policy.reset()
            before = episode
            obs = {key: array[row : row + 1] for key, array in episode.observations.items()}
            actions.append(policy.predict_action(obs, noise=each)["action"][0])
            assert policy.last_report is not None
            work += policy.last_report.frames
        return np.asarray(actions, np.float64), work
