"""One recorded episode with a plan: what its calls execute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.lattice import PlanArray, Source
from ..runtimes.policy import CompiledPolicy
from ..trajectories.episodes import Episode

EPISODE_CALLS = 64
"""Of an episode at most: a picture of more says no more."""


@dataclass(frozen=True)
class Course:
    """One episode with one plan.

    Attributes:
        plans: int8 ``[R, K, blocks]``, as executed.
        legalised: cells of each call that were replaced because they were never computed.
    """

    name: str
    plans: PlanArray
    legalised: tuple[int, ...]

    @property
    def sparsity(self) -> npt.NDArray[np.float64]:
        """Share of reused cells of each call, ``[R]``."""
        return np.asarray(np.mean(self.plans != Source.COMPUTE, axis=(1, 2)), dtype=np.float64)

    def shares(self) -> npt.NDArray[np.float64]:
        """For each source and cell the share of calls in which the cell had it, ``[4, K, blocks]``."""
        return np.stack([np.mean(self.plans == source, axis=0) for source in Source])


def run_episode(policy: CompiledPolicy, episode: Episode, plan: str | None = None) -> Course:
    """A plan, or the policy's default, on the first ``EPISODE_CALLS`` calls of an episode; reset before and after."""
    policy.reset()
    made = []
    for row in range(min(episode.calls, EPISODE_CALLS)):
        obs = {key: array[row : row + 1] for key, array in episode.observations.items()}
        policy.predict_action(obs, plan=plan)
        report = policy.last_report
        assert report is not None  # a call was made
        made.append(report)
    policy.reset()
    plans = np.stack([report.plan[0] for report in made])
    return Course(episode.name, plans, tuple(report.legalised[0] for report in made))
