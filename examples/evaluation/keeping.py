"""A policy that goes on with the chunk of the call before, where a doubt allows it: ``kept_chunk.py``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from doubts import Array, Doubt, Going, flat
from rollout import Episode
from variants import Variant

import ttscompile
from ttscompile.core.lattice import Source
from ttscompile.core.spec import ChunkSpec
from ttscompile.runtimes.info import PolicyInfo


@dataclass
class Slots:
    """What calls of a batch of episodes did, in order: arrays with a row for each stream.

    Attributes:
        drawn: whether a chunk was drawn.
        checked: whether the one before had enough actions left to go on.
        steps: evaluations of the loop.
        distances: of the doubt; NaN where there was none.
        known: the observation, and what is executed.
        seen: the observation.
    """

    drawn: list[Array] = field(default_factory=list)
    checked: list[Array] = field(default_factory=list)
    steps: list[Array] = field(default_factory=list)
    distances: list[Array] = field(default_factory=list)
    known: list[Array] = field(default_factory=list)
    seen: list[Array] = field(default_factory=list)


class Keeping:
    """A policy that goes on with chunks.

    Args:
        variant: what draws.
        chunk: what of a sample is action.
        horizon: actions from one call to the next.
        doubt: that decides; None where each call draws.
        threshold: above which distance a chunk is drawn.
    """

    def __init__(
        self, variant: Variant, chunk: ChunkSpec, horizon: int, doubt: Doubt | None = None, threshold: float = np.inf
    ) -> None:
        self._variant, self._chunk, self._horizon = variant, chunk, horizon
        self._doubt, self._threshold = doubt, threshold
        self.info: PolicyInfo = variant.policy.info
        self.batches: list[Slots] = []

    def reset(self) -> None:
        """A new episode."""
        self._variant.policy.reset()
        if self._doubt is not None:
            self._doubt.reset()
        self._going: Going | None = None
        self.batches.append(Slots())

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: ttscompile.Noise | None = None, plan: object = None
    ) -> Mapping[str, Any]:
        """One call. All streams are drawn anew, but only those that have to be are counted."""
        assert noise is not None
        chunk, h, log, going, seen = self._chunk, self._horizon, self.batches[-1], self._going, flat(obs_dict)
        made, steps = self._drawn(obs_dict, noise)
        fresh, whole = noise.initial[:, : made.shape[1]], np.full(len(made), made.shape[1] - chunk.start)
        after, noises, left = made, fresh, whole
        drawn, checked, distances = np.ones(len(made), np.bool_), whole < 0, np.full(len(made), np.nan)
        if going is not None and self._doubt is not None:
            verdict = self._doubt.judge(obs_dict, fresh, going)
            answered = verdict.clean is not None
            checked = (going.left >= h) | answered
            drawn = ~checked | (verdict.distances > self._threshold)
            distances = np.where(checked, verdict.distances, np.nan)
            old = drawn[:, None, None], going.chunk if verdict.clean is None else verdict.clean
            after, noises = np.where(old[0], made, old[1]), np.where(old[0], fresh, going.noise)
            left = np.where(drawn | answered, whole, going.left)
        done = after[:, chunk.start : chunk.start + h].reshape(len(made), -1)
        told = drawn, checked, steps * drawn, distances, np.concatenate([seen, done], 1), seen
        for name, array in zip(("drawn", "checked", "steps", "distances", "known", "seen"), told, strict=True):
            getattr(log, name).append(array)
        noises, pictures = np.concatenate([noises[:, h:], fresh[:, :h]], 1), self._pictures(obs_dict, drawn)
        self._going = Going(chunk.moved(after, h), noises, left - h, seen, done, pictures)
        return {"action": chunk.unnormalized(after)[:, chunk.start : chunk.start + h]}

    def _pictures(self, obs: Mapping[str, Any], drawn: Array) -> dict[str, Array]:
        """Those that the chunk of each stream was drawn with."""
        new = {key: np.asarray(obs[key]) for key, one in self.info.observation.items() if one.image}
        if (going := self._going) is None:
            return new
        which = {key: drawn.reshape(-1, *[1] * (one.ndim - 1)) for key, one in new.items()}
        return {key: np.where(which[key], one, going.pictures[key]) for key, one in new.items()}

    def _drawn(self, obs: Mapping[str, Any], noise: ttscompile.Noise) -> tuple[Array, Array]:
        """Chunks ``[B, T, D]``, normalised, and how many evaluations each took."""
        policy: Any = self._variant.policy
        if self._going is not None:
            policy.follow(self._horizon)
        predicted = policy.predict_action(obs, noise=noise, plan=self._variant.plan)["action_pred"]
        computed = (policy.last_report.plan == Source.COMPUTE).any(-1).sum(-1)
        return self._chunk.normalized(np.asarray(predicted)), computed


def active(slots: Sequence[Slots], name: str, episodes: Sequence[Episode]) -> list[Array]:
    """What is known of the calls of each episode, in order, while it was not done."""
    columns = [(one, i) for one in slots for i in range(len(one.drawn[0]))]
    arrays = ([row[i] for row in getattr(one, name)] for one, i in columns)
    return [np.stack(rows[: episode.calls]) for rows, episode in zip(arrays, episodes, strict=True)]
