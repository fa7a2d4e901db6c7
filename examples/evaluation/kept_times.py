"""What a call takes that draws a chunk, checks the one before, or does both: for ``kept_chunk.py``.

The evaluation that checks is a warm call of the last step: what comes before the loop, and the network once. Only its
numbers differ from a check's, not what is computed. Where a check fails, the call draws with what is known by then of
the same pictures. Calls are of one robot and one thread, and see other pictures than the call before. Milliseconds are
the processor's, medians: the machine may be busy.
"""

from __future__ import annotations

import shutil
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from doubts import Array, Check, Doubt
from variants import full_plan, open_variant, seeded_noise
from warm_start import WARM, add_warm_plans

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.runtimes.policy import CompiledPolicy

ONCE = f"{WARM}-1"
"""The plan that evaluates the network once."""

DRAWN, CHECKED, BOTH, BLIND, BLIND_BOTH = "drawn", "checked", "both", "checked blindly", "both, blindly"
"""Kinds of calls. A blind check has the pictures of the call before, whose features are known."""


@dataclass(frozen=True)
class Times:
    """Milliseconds of a call: that draws, that goes on with the chunk before, and that doubts it and draws."""

    drawn: float
    going: float
    both: float

    @classmethod
    def by(cls, kinds: Mapping[str, float], doubt: Doubt | None) -> Times:
        """Of the calls that a doubt makes."""
        drawn = kinds[DRAWN]
        if not isinstance(doubt, Check):  # what doubts then is no network
            return cls(drawn, 0.0, drawn)
        going, both = (BLIND, BLIND_BOTH) if doubt.blind else (CHECKED, BOTH)
        return cls(drawn, kinds[going], kinds[both])

    def of(self, drawn: Array, checked: Array) -> Array:
        """Of each call: whether it drew, and whether it could have gone on."""
        told: Array = np.where(checked, np.where(drawn, self.both, self.going), self.drawn)
        return told


def warmed(directory: Path, numbers: Sequence[int], folder: Path) -> Path:
    """A copy of an artifact, in a folder, with a plan ``warm-N`` of the last N steps of the whole loop for each N."""
    copy = folder / directory.resolve().name
    shutil.copytree(directory, copy)
    artifact = load_artifact(copy)
    update_plans(copy, artifact.plans, full_plan(copy))
    add_warm_plans(copy, numbers)
    update_plans(copy, load_artifact(copy).plans, artifact.manifest.default_plan)
    return copy


class Stopwatch:
    """Times calls of an artifact; those that check need its plan ``warm-1``.

    Args:
        variant: the artifact, and the plan that draws: ``DIR`` or ``DIR:PLAN``.
        horizon: actions from one call to the next.
    """

    def __init__(self, variant: str, horizon: int) -> None:
        opened = open_variant(variant, "onnxruntime", 1)
        assert isinstance(opened.policy, CompiledPolicy)
        self._policy, self._noise, self._horizon = opened.policy, opened.noise, horizon
        self._pictures = [key for key, one in opened.policy.info.observation.items() if one.image]
        checks = [CHECKED, BOTH, *((BLIND, BLIND_BOTH) if self._pictures else ())]
        self._kinds = [DRAWN, *(checks if ONCE in opened.policy.plans else ())]

    def times(self, seen: Sequence[tuple[Mapping[str, Array], Mapping[str, Array]]]) -> dict[str, float]:
        """Milliseconds of each kind of call.

        Args:
            seen: what two consecutive calls of an episode saw, ``[To, ...]`` by key; two of these at least.
        """
        took: dict[str, list[float]] = {kind: [] for kind in self._kinds}
        self._policy.reset()
        for pair in seen:
            before, now = ({key: array[None] for key, array in one.items()} for one in pair)
            for kind, own in took.items():
                self._policy.forget_frames()
                self._call(before, None)
                self._policy.follow(self._horizon)
                own.append(self._timed(kind, before, now))
        return {kind: statistics.median(own[1:]) for kind, own in took.items()}  # the first opens what it needs

    def _timed(self, kind: str, before: Mapping[str, Array], now: Mapping[str, Array]) -> float:
        known = {key: before[key] for key in self._pictures} if kind in (BLIND, BLIND_BOTH) else {}
        start = time.process_time()
        if kind != DRAWN:
            self._call({**now, **known}, ONCE)
        if kind not in (CHECKED, BLIND):
            self._call(now, None)
        return 1000 * (time.process_time() - start)

    def _call(self, obs: Mapping[str, Array], plan: str | None) -> None:
        self._policy.predict_action(obs, noise=seeded_noise(self._noise, [0], 0), plan=plan)
