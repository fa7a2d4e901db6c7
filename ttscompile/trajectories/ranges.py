"""Whether recordings are of what the policy was trained on, as far as its normaliser tells."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from ..core.spec import PolicySpec
from ..errors import TrajectoryError
from .episodes import Episode

REACH = 1.05
"""Normalised numbers are outside beyond this, either way: recordings may stray a little from the training data."""

SOME, MOST = 0.02, 0.5
"""Shares of a key's numbers outside that are worth a warning, and an error. Of numbers whose mean is 0 and deviation 1,
which another kind of normaliser makes, a third are outside; with a unit or an order of their own nearly all are."""


def check_ranges(episodes: Sequence[Episode], spec: PolicySpec) -> None:
    """Warn of recorded numbers outside of what the normaliser maps to -1..1, and raise where most are.

    A normaliser by mean and deviation does not say where the training data ended. Whether it is one is known of the
    actions alone, whose kind observations mostly share: so where it is, nothing is warned of.

    Raises:
        TrajectoryError: says how many there are, and in which columns.
    """
    for key, one in spec.observations.items():
        if one.normalizer is None or np.dtype(one.dtype).kind != "f" or one.image:
            continue
        values = one.normalized(np.concatenate([each.observations[key] for each in episodes]))
        columns = np.abs(values).reshape(-1, values.shape[-1])
        outside = columns > REACH
        share = float(outside.mean())
        if share <= (SOME if spec.chunk.ranged else MOST):
            continue
        worst = np.argsort(-outside.mean(0), kind="stable")[: int(outside.any(0).sum())].tolist()
        told = ", ".join(f"{n} ({outside[:, n].mean():.0%})" for n in worst[:5]) + ", .." * (len(worst) > 5)
        problem = (
            f"observation {key!r}: {outside.sum()} of {outside.size} recorded numbers ({share:.0%}) lie outside of what"
            f" the policy's normaliser maps to -1..1, by up to {columns.max():.3g} times; columns {told}. Look at their"
            " unit, at the order of the columns, and at --observation"
        )
        if share > MOST:
            raise TrajectoryError(f"{problem}: what the policy answers to these means nothing.")
        warnings.warn(f"{problem}, unless the policy was trained on these.", stacklevel=2)
