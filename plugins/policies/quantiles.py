"""Statistics of a data set as Octo and OpenVLA's descendants save them, and which numbers are left as they are."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile.core.spec import Affine, Switch
from ttscompile.frontends.saved_weights import names_of
from ttscompile.frontends.settings import Settings, read_json

STATISTICS = "dataset_statistics.json"
GRIPPER = 6
"""The number of an arm's action that the originals make 0 or 1."""
_LEAST_WIDTH = 1e-8

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Range:
    """What becomes -1..1: numbers between two quantiles, but for those that stay what they are."""

    low: Vector
    high: Vector
    mask: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Statistics:
    """How actions leave -1..1, and whose statistics say so.

    Attributes:
        state: the range of what the robot's state was; None where it is not asked for, or not there.
    """

    name: str
    normalizer: Affine | None
    switches: tuple[Switch, ...]
    state: Range | None = None


def read_statistics(path: Path, actions: int, grippers: tuple[int, ...], state: int | None = None) -> Statistics:
    """Those of the one data set that the policy was trained on; else actions stay in -1..1, with a warning.

    Args:
        path: of a checkpoint in a folder ``checkpoints``, beside which they are.
        actions: numbers of an action.
        grippers: which of them are 0 from -1 on, and 1 from 0.5 on.
        state: numbers of the robot's state, whose range is wanted, too.
    """
    where = path.absolute().parents[1] / STATISTICS
    sets = read_json(where) if where.is_file() else {}
    switches = tuple(Switch(channel, 0.5, 0.0, 1.0) for channel in grippers)
    if len(sets) != 1:
        there = f"holds {len(sets)} data sets ({names_of(sorted(sets))})" if where.is_file() else "is not there"
        given = "" if state is None else " The state has to be given as the network sees it."
        warnings.warn(
            f"{where} {there}: actions stay in -1..1, as the network makes them.{given} For those of a robot, put a"
            " file there that holds its data set alone, and convert again.",
            stacklevel=4,
        )
        return Statistics("none", None, switches)
    name, entry = next(iter(sets.items()))
    own = _range(where, name, entry, "action", actions)
    width = own.high - own.low
    width[width == 0] = _LEAST_WIDTH  # one that never changed stays what it was
    normalizer = Affine(np.where(own.mask, 2 / width, 1.0), np.where(own.mask, -2 * own.low / width - 1, 0.0))
    for place, channel in enumerate(grippers):
        if own.mask[channel]:
            closed, opened = ((end + 1) / 2 * float(width[channel]) + float(own.low[channel]) for end in (0, 1))
            switches = (*switches[:place], Switch(channel, 0.5, closed, opened), *switches[place + 1 :])
    return Statistics(
        name, normalizer, switches, None if state is None else _range(where, name, entry, "proprio", state)
    )


def read_moments(where: Path, actions: int) -> tuple[str, Affine | None]:
    """The one data set of Octo's, whose actions have mean 0 and deviation 1; else they stay so, with a warning."""
    sets = {} if not where.is_file() or _is_null(where) else read_json(where)
    sets = {"its own": sets} if "action" in sets else sets  # of a training on one
    if len(sets) != 1:
        named = names_of(sorted(sets)) or "none"
        there = f"holds {len(sets)} data sets ({named})" if where.is_file() else "is not there"
        warnings.warn(
            f"{where} {there}: actions have mean 0 and deviation 1, as the network makes them. For those of a robot,"
            " put a file there that holds its data set alone, and convert again.",
            stacklevel=4,
        )
        return "none", None
    name, entry = next(iter(sets.items()))
    settings, mask = _settings(where, name, entry, "action", actions)
    mean, deviation = (_vector(settings, key, actions) for key in ("mean", "std"))
    if (deviation < 0).any():
        raise settings.refusal("std", "numbers that are not negative")
    deviation = np.maximum(deviation, _LEAST_WIDTH)
    return name, Affine(np.where(mask, 1 / deviation, 1.0), np.where(mask, -mean / deviation, 0.0))


def _is_null(where: Path) -> bool:
    """Whether a model without statistics was saved, of which Octo writes this."""
    with where.open("rb") as file:
        return file.read(9).strip() == b"null"


def _range(where: Path, name: str, entry: Any, part: str, count: int) -> Range:
    settings, mask = _settings(where, name, entry, part, count)
    low, high = (_vector(settings, key, count) for key in ("q01", "q99"))
    return Range(low, high, mask)


def _settings(where: Path, name: str, entry: Any, part: str, count: int) -> tuple[Settings, npt.NDArray[np.bool_]]:
    """What is known of the actions, say, and which of their numbers that is for."""
    inner = entry.get(part) if isinstance(entry, dict) else None
    settings = Settings(
        inner if isinstance(inner, dict) else {}, f"{where}: {name:.80}.{part}.", "Copy the file again."
    )
    mask = settings.values.get("mask", [True] * count)
    if not (isinstance(mask, list) and len(mask) == count and all(type(one) is bool for one in mask)):
        raise settings.refusal("mask", f"{count} times true or false")
    return settings, np.array(mask)


def _vector(settings: Settings, name: str, count: int) -> Vector:
    value: Any = settings.values.get(name)
    if isinstance(value, list) and len(value) == count and all(type(one) in (int, float) for one in value):
        found = np.array(value, np.float64)
        if np.isfinite(found).all():
            return found
    raise settings.refusal(name, f"{count} finite numbers")
