"""Corrections among the arrays of an artifact's plans: ``correction/PLAN/FIELD``, with jumps or without."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import MISSING, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.correction import Correction
from ..errors import ArtifactError
from .strict_json import REMEDY

PREFIX = "correction/"

_OF_ALL = tuple(field.name for field in fields(Correction) if field.default_factory is MISSING)
_OF_JUMPS = tuple(field.name for field in fields(Correction) if field.name not in _OF_ALL)


def correction_arrays(plan: str, correction: Correction) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a plan's correction, by name."""
    names = (*_OF_ALL, *(_OF_JUMPS if correction.jumps else ()))
    return {f"{PREFIX}{plan}/{name}": np.asarray(getattr(correction, name)) for name in names}


def read_corrections(
    stored: Mapping[str, npt.NDArray[Any]], plans: Collection[str], where: str
) -> dict[str, Correction]:
    """The corrections among some arrays, by the name of the plan.

    Args:
        stored: arrays; those of other names are left alone.
        plans: names of the artifact's plans.
        where: for messages.

    Raises:
        ArtifactError: a correction of no plan, or one that lacks a field or has another.
        IllegalPlanError: its arrays do not fit each other.
    """
    parts = {name.removeprefix(PREFIX): array for name, array in stored.items() if name.startswith(PREFIX)}
    names = sorted({name.rpartition("/")[0] for name in parts})
    wanted = {name: _OF_ALL + _OF_JUMPS * (f"{name}/{_OF_JUMPS[0]}" in parts) for name in names}
    if not set(names) <= set(plans) or {f"{name}/{one}" for name in names for one in wanted[name]} != set(parts):
        raise ArtifactError(
            f"{where}: expected corrections of plans among {sorted(plans)}, each with {', '.join(_OF_ALL)}, and"
            f" {', '.join(_OF_JUMPS)} if it has jumps; found {sorted(parts)}. {REMEDY}"
        )
    return {name: Correction(**{one: parts[f"{name}/{one}"] for one in wanted[name]}) for name in names}
