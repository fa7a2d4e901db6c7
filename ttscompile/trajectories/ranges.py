"""Whether recordings are of what the policy was trained on, as far as its normaliser tells."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.spec import Affine, ObservationSpec, PolicySpec
from ..errors import TrajectoryError
from .episodes import Episode

REACH = 1.05
"""Normalised numbers are outside beyond this, either way: recordings may stray a little from the training data."""

SOME, USUAL, MOST = 0.02, 0.1, 0.5
"""Shares of a key's numbers outside that are worth a warning, of a normaliser and of statistics, and an error. Of
numbers whose mean is 0 and deviation 1, which another kind of normaliser makes, a third are outside; with a unit or an
order of their own nearly all are."""


@dataclass(frozen=True)
class Placed:
    """Recorded numbers of one key, and the range of the training data.

    Attributes:
        values: ``[N, D]``, as they were recorded.
        seen: maps the range of the training data to -1..1.
        some: share of numbers outside that is worth a warning.
    """

    key: str
    values: npt.NDArray[np.float32]
    seen: Affine
    some: float

    @property
    def normalized(self) -> npt.NDArray[np.float32]:
        """The numbers where the range of the training data is -1..1."""
        return self.seen.normalize(self.values)

    @property
    def outside(self) -> npt.NDArray[np.bool_]:
        """``[N, D]``: which of them lie outside of the range."""
        return np.abs(self.normalized) > REACH

    def in_place_of(self) -> dict[int, int]:
        """Columns that lie outside of their own range, by another such column whose range they lie in; all, or none."""
        wrong = np.flatnonzero(self.outside.mean(0) > MOST)
        found: dict[int, int] = {}
        for column in wrong.tolist():
            moved = self.values[:, [column]] * self.seen.scale[wrong] + self.seen.offset[wrong]
            fits = wrong[(np.abs(moved) > REACH).mean(0) <= SOME].tolist()
            free = [n for n in fits if n not in found.values()]
            if not free:
                return {}
            found[column] = free[0]
        return found


def placed(episodes: Sequence[Episode], spec: PolicySpec) -> Iterator[Placed]:
    """The recorded numbers of every key of which it is known where those of the training data were."""
    for key, one in spec.observations.items():
        seen = _seen(one)
        if seen is None or np.dtype(one.dtype).kind != "f" or one.image:
            continue
        values = np.concatenate([each.observations[key] for each in episodes])
        some = MOST if not spec.chunk.ranged else SOME if one.normalizer is not None else USUAL
        yield Placed(key, values.reshape(-1, values.shape[-1]), seen, some)


def _seen(one: ObservationSpec) -> Affine | None:
    """The normaliser, or what the statistics of a normaliser inside of the network say; a width of 0 is hardly any."""
    if one.normalizer is not None or one.bounds is None:
        return one.normalizer
    low, high = (np.broadcast_to(np.asarray(end, np.float64), one.shape[-1:]) for end in one.bounds)
    width = np.maximum(high - low, 1e-3 * np.maximum(np.abs(low), 1e-3))
    return Affine((2 / width).astype(np.float32), (-(low + high) / width).astype(np.float32))


def check_ranges(episodes: Sequence[Episode], spec: PolicySpec) -> None:
    """Warn of recorded numbers outside of what the normaliser maps to -1..1, and raise where most are.

    A normaliser by mean and deviation does not say where the training data ended. Whether it is one is known of the
    actions alone, whose kind observations mostly share: so where it is, nothing is warned of.

    Raises:
        TrajectoryError: says how many there are, and in which columns.
    """
    for one in placed(episodes, spec):
        if (share := float(one.outside.mean())) <= one.some:
            continue
        problem = (
            f"observation {one.key!r}: {told_outside(one)}. Look at their unit, at the order of the columns, and at"
            " --observation"
        )
        if share > MOST:
            raise TrajectoryError(f"{problem}: what the policy answers to these means nothing.")
        warnings.warn(f"{problem}, unless the policy was trained on these.", stacklevel=2)


def told_outside(one: Placed) -> str:
    """How many recorded numbers lie outside, and in which columns."""
    outside = one.outside
    worst = np.argsort(-outside.mean(0), kind="stable")[: int(outside.any(0).sum())].tolist()
    told = ", ".join(f"{n} ({outside[:, n].mean():.0%})" for n in worst[:5]) + ", .." * (len(worst) > 5)
    return (
        f"{outside.sum()} of {outside.size} recorded numbers ({outside.mean():.0%}) lie outside of what the policy's"
        f" normaliser maps to -1..1, by up to {np.abs(one.normalized).max():.3g} times; columns {told}"
    )
