"""What blocks of another precision than fp32 add to the error of plans, on held-out calls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..artifact.load import Artifact
from ..artifact.manifest import DENSE
from ..core.correction import Correction
from ..core.lattice import PlanArray, Source
from ..runtimes.random_calls import normalized, random_noise
from ..trajectories.episodes import Episode
from ..verification.against_fp32 import Call, action_errors, compare
from .calls import sample_calls

HELD_OUT = 8
"""Calls; on Push-T at K = 100 about one second each, the dense ones for the most part."""


def precision_record(
    artifact: Artifact,
    episodes: Sequence[Episode],
    numbers: Sequence[int],
    name: str,
    plan: PlanArray,
    correction: Correction | None,
    seed: int,
) -> dict[str, Any]:
    """Actions in the artifact's precision against those in fp32 with the same plan and noise.

    So this is the error of the precision alone; that of the plan is measured in fp32, and has its own figures.

    Args:
        artifact: the policy.
        episodes: all of them.
        numbers: of those that were held out.
        name: of a schedule beside ``dense``.
        plan: the schedule, ``[K, blocks]``; left out if it reads earlier calls, which these calls do not have.
        correction: of the schedule; None for none.
        seed: of calls and noise.

    Returns:
        ``{"precision": {"name": .., "calls": .., "plans": {plan: {"error": .., "error_p90": ..}}}}`` for the
        calibration record, in the units of the actions; empty for an artifact in fp32.
    """
    manifest = artifact.manifest
    if manifest.precision is None:
        return {}
    chosen = sample_calls(episodes, numbers, HELD_OUT, seed)
    plans = ((DENSE, artifact.schedule(DENSE), None), (name, plan, correction))
    scores = {}
    for title, each, its_correction in plans:
        if (each == Source.ROLLOUT).any():
            continue
        pairs = compare(artifact, each, _calls(artifact, episodes, chosen, seed), its_correction)
        errors = [action_errors(manifest.spec.chunk, one, other).mean() for one, other in pairs]
        scores[title] = {"error": float(np.mean(errors)), "error_p90": float(np.quantile(errors, 0.9))}
    return {"precision": {"name": manifest.precision.name, "calls": len(chosen), "plans": scores}}


def _calls(
    artifact: Artifact, episodes: Sequence[Episode], chosen: Sequence[tuple[int, int]], seed: int
) -> Iterator[Call]:
    spec = artifact.manifest.spec
    draw = np.random.default_rng((seed, 3))
    for number, row in chosen:
        obs = {key: episodes[number].observations[key][row : row + 1] for key in spec.observations}
        yield normalized(spec, obs), random_noise(spec, draw)
