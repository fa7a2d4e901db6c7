"""Corrections among the arrays of an artifact's plans: ``correction/PLAN/FIELD``, with jumps or without."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.correction import Correction, groups_of
from ..errors import ArtifactError, IllegalPlanError
from .manifest import Manifest
from .strict_json import REMEDY

PREFIX = "correction/"

_OF_ALL = tuple(field.name for field in fields(Correction) if field.default_factory is MISSING)
_OF_JUMPS = tuple(field.name for field in fields(Correction) if field.name not in _OF_ALL)


def correction_arrays(plan: str, correction: Correction) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a plan's correction, by name."""
    names = (*_OF_ALL, *(_OF_JUMPS if correction.jumps else ()))
    return {f"{PREFIX}{plan}/{name}": np.asarray(getattr(correction, name)) for name in names}


def read_corrections(stored: Mapping[str, npt.NDArray[Any]], manifest: Manifest, where: str) -> dict[str, Correction]:
    """The corrections among some arrays, by the name of the plan; arrays of other names are left alone."""
    parts = {name.removeprefix(PREFIX): array for name, array in stored.items() if name.startswith(PREFIX)}
    wanted = dict[str, tuple[str, ...]]()
    for name in sorted({name.rpartition("/")[0] for name in parts}):
        wanted[name] = (*_OF_ALL, *_OF_JUMPS) if f"{name}/{_OF_JUMPS[0]}" in parts else _OF_ALL
    plans = set(manifest.plans)
    if not wanted.keys() <= plans or {f"{name}/{one}" for name, of in wanted.items() for one in of} != set(parts):
        raise ArtifactError(
            f"{where}: expected corrections of plans among {sorted(plans)}, each with {', '.join(_OF_ALL)}, and"
            f" {', '.join(_OF_JUMPS)} if it has jumps; found {sorted(parts)}. {REMEDY}"
        )
    found = dict[str, Correction]()
    for name, of in wanted.items():
        try:
            found[name] = Correction(**{one: parts[f"{name}/{one}"] for one in of})
            require_fit(found[name], manifest, manifest.plans[name].loop)
        except IllegalPlanError as error:
            raise ArtifactError(f"{where}: {name}: {error} {REMEDY}") from error
    return found


def require_fit(correction: Correction, manifest: Manifest, loop: str) -> None:
    """Raise IllegalPlanError unless it is a correction for this loop of a policy."""
    start, sample = manifest.starts.get(loop), manifest.spec.sample
    whole = manifest.steps_of(loop if start is None else start.loop)
    correction.require_fit(manifest.steps_of(loop), sample, manifest.condition_numbers, groups_of(whole, sample))
