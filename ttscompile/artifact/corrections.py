"""Corrections among the arrays of an artifact's plans: ``correction/PLAN/FIELD``, with jumps or without.

Beside them stands what was recorded to fit them: ``envelope/FIELD``.
"""

from dataclasses import MISSING, fields, replace
from itertools import chain
from typing import Any

import numpy as np

from ..core.coercion import Array, Arrays
from ..core.correction import Correction, groups_of
from ..core.envelope import Envelope
from ..errors import ArtifactError, IllegalPlanError
from .manifest import Manifest
from .strict_json import REMEDY

PREFIX, ENVELOPE = "correction/", "envelope/"

LATE = "/late"
"""After the name of a plan: of its calls with a prefix."""

_OF_JUMPS, _OF_PREFIXES = ("inner", "middle", "outer"), ("prefixes",)
_OF_ALL = tuple(one.name for one in fields(Correction) if one.default is one.default_factory is MISSING)


def correction_arrays(plan: str, correction: Correction) -> dict[str, Array]:
    """The arrays of a plan's correction, by name."""
    names = (*_OF_ALL, *_OF_JUMPS * bool(correction.jumps), *_OF_PREFIXES * bool(correction.prefixes))
    own = {f"{PREFIX}{plan}/{name}": np.asarray(getattr(correction, name)) for name in names}
    return own if correction.late is None else own | correction_arrays(plan + LATE, correction.late)


def envelope_arrays(envelope: Envelope | None) -> dict[str, Array]:
    """The arrays of an envelope, by name; none if there is none."""
    of = () if envelope is None else fields(Envelope)
    return {f"{ENVELOPE}{one.name}": getattr(envelope, one.name) for one in of}


def read_envelope(stored: Arrays, manifest: Manifest, where: str) -> Envelope | None:
    """The envelope among some arrays; None if there is none."""
    parts = {name.removeprefix(ENVELOPE): array for name, array in stored.items() if name.startswith(ENVELOPE)}
    if not parts:
        return None
    expected, numbers = sorted(field.name for field in fields(Envelope)), manifest.condition_numbers
    if sorted(parts) != expected:
        raise ArtifactError(f"{where}: expected an envelope of {expected}; found {sorted(parts)}. {REMEDY}")
    try:
        envelope = Envelope(**parts)
    except IllegalPlanError as error:
        raise ArtifactError(f"{where}: {error} {REMEDY}") from error
    if len(envelope.reading) != numbers:
        found = f"an envelope of {numbers} numbers of the condition; found one of {len(envelope.reading)}"
        raise ArtifactError(f"{where}: expected {found}. {REMEDY}")
    return envelope


def read_corrections(stored: Arrays, manifest: Manifest, where: str) -> dict[str, Correction]:
    """The corrections among some arrays, by the name of the plan; arrays of other names are left alone."""
    parts = {name.removeprefix(PREFIX): array for name, array in stored.items() if name.startswith(PREFIX)}
    wanted = dict[str, tuple[str, ...]]()
    for name in sorted({name.rpartition("/")[0] for name in parts}):
        also = (of for of in (_OF_JUMPS, _OF_PREFIXES) if f"{name}/{of[0]}" in parts)
        wanted[name] = (*_OF_ALL, *chain.from_iterable(also))
    plans = {*manifest.plans, *(name + LATE for name in manifest.plans if name in wanted)}
    if not wanted.keys() <= plans or {f"{name}/{one}" for name, of in wanted.items() for one in of} != set(parts):
        raise ArtifactError(
            f"{where}: expected corrections of plans among {sorted(manifest.plans)}, each with {', '.join(_OF_ALL)},"
            f" {', '.join(_OF_JUMPS)} if it has jumps, and {_OF_PREFIXES[0]} if it was fitted with any; found"
            f" {sorted(parts)}. {REMEDY}"
        )
    found = dict[str, Correction]()
    for name, of in wanted.items():
        own: dict[str, Any] = {one: parts[f"{name}/{one}"] for one in of}
        try:
            found[name] = Correction(**own)
            require_fit(found[name], manifest, manifest.plans[name.removesuffix(LATE)].loop)
        except IllegalPlanError as error:
            raise ArtifactError(f"{where}: {name}: {error} {REMEDY}") from error
    late = {name.removesuffix(LATE): found.pop(name) for name in wanted if name.endswith(LATE)}
    return {name: replace(one, late=late.get(name)) for name, one in found.items()}


def require_fit(correction: Correction, manifest: Manifest, loop: str) -> None:
    """Raise IllegalPlanError unless it is a correction for this loop of a policy."""
    sample, whole = manifest.spec.sample, manifest.steps_of(manifest.whole_loop(loop))
    correction.require_fit(manifest.steps_of(loop), sample, manifest.condition_numbers, groups_of(whole, sample))
