"""What calibrations of all kinds are given alike: refused where it cannot be, and what follows from it."""

import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..artifact.load import load_artifact
from ..artifact.manifest import Manifest
from ..core.correction import FEATURES, may_jump
from ..errors import CalibrationError
from ..ir.program import Binding

EVALUATIONS_A_MINUTE = 6400
"""Of the network, to make the calls to learn from, for each minute of the time limit; ``Trials`` may have more."""

FEWEST_CALLS, MOST_CALLS = 64, 3072

MOST_LEARNED = 12288
"""Calls to learn from at most where a network does, in a jump or in a distillation: it fits what it has seen more
closely than a linear correction does, and noise is free."""

ROOM = 2 << 30
"""Bytes that the contexts of more than ``MOST_CALLS`` may take."""

MOST_NEEDED = 1024
"""Calls that a correction needs at most, however much it reads: these are answered whatever the time."""

CALLS_A_FEATURE = 3
"""Calls to learn from at least, for each number that a correction reads. On Push-T (97 of them, 95 %) one that is
fitted on 30 calls does harm, on 64 it lowers the held-out error from 19 to 6 px, on 128 to 2.7."""


class CallLimits(NamedTuple):
    """How many calls are learned from."""

    fewest: int = FEWEST_CALLS
    """That are answered whatever the time."""

    usual: int = FEWEST_CALLS
    """If there is time."""

    most: int = FEWEST_CALLS
    """If they take little of it."""


def require_limits(fraction: float, minutes: float, distance: float | None, policy_hz: float | None) -> None:
    """Raise CalibrationError unless some episodes are held out and others are not, and all else is above 0, or none."""
    if not 0 < fraction < 1 or not minutes > 0:
        raise CalibrationError(
            f"expected validation_fraction between 0 and 1 and max_minutes above 0; found {fraction} and {minutes}."
        )
    if distance is not None and not distance > 0:
        raise CalibrationError(f"max_distance: expected a positive number; found {distance}.")
    require_rate(policy_hz)


def require_rate(policy_hz: float | None) -> None:
    """Raise CalibrationError unless it is a rate, or none."""
    if policy_hz is not None and not 0 < policy_hz < math.inf:
        raise CalibrationError(f"policy_hz: expected a positive number; found {policy_hz}.")


def require_one_place(device: str | None, ray: str | None) -> None:
    """Raise CalibrationError where both a device and a cluster are to compute."""
    if ray is not None and device is not None:
        raise CalibrationError(
            f"expected a device or a cluster; found device {device!r} and ray {ray!r}: workers of a cluster compute on"
            " their processors. Leave one of the two out."
        )


def require_no_cells(*budgets: float | None) -> None:
    """Raise where a budget is given that loops, which are learned, cannot keep."""
    if any(one is not None for one in budgets):
        raise CalibrationError(
            "learn: loops are chosen by their distance from the original and by their time; found a budget in cells."
            " Give max_distance or latency_ms, or learn a schedule."
        )


def require_directory(path: Path) -> None:
    """Raise unless an artifact is one that can be written into, ArtifactError where it is none at all."""
    if not path.is_dir():
        load_artifact(path)
        raise CalibrationError(f"{path}: only a directory can be changed. Unzip the artifact and give the directory.")
    if not os.access(path, os.W_OK | os.X_OK):  # told now, not after minutes of work
        raise CalibrationError(
            f"{path}: nothing can be written there. Give a copy of the artifact that can be changed."
        )


def calls_to_learn_from(manifest: Manifest, max_minutes: float, *, corrects: bool, trains: bool = False) -> CallLimits:
    """How many calls a calibration of so many minutes learns from; ``corrects`` and ``trains``: see ``Row``."""
    spec, most = manifest.spec, MOST_CALLS
    if trains or (corrects and may_jump(spec.sample)):
        most = int(np.clip(ROOM // _context_bytes(manifest), MOST_CALLS, MOST_LEARNED))
    fewest = min(CALLS_A_FEATURE * (FEATURES * spec.sample[0] + 1), MOST_NEEDED) if corrects else FEWEST_CALLS
    usual = int(np.clip(EVALUATIONS_A_MINUTE / spec.sampler.steps * max_minutes, fewest, most))
    return CallLimits(fewest, usual, most)


def _context_bytes(manifest: Manifest) -> int:
    """Of what the prologue gives the loop of one call."""
    types = [record.type for record in manifest.contexts.values() if record.binding is Binding.CONDITION]
    return max(1, sum(math.prod(kind.at(1)) * np.dtype(kind.dtype).itemsize for kind in types))
