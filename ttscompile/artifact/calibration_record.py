"""What the record of a calibration must be where commands read it; the rest of it is free JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .strict_json import Value
from .typed_json import read_as

_SCORE = ("distance", "error", "error_p90", "of_other_noise", "sparsity", "flops_sparsity", "flops_saved", "tokens")
_BUDGET = ("target_sparsity", "target_flops", "latency_ms", "max_action_error")
_RECORD: Mapping[str, Any] = {
    "strategy": str,
    "seed": int,
    "learned": tuple[str, ...],
    "plans": Mapping[str, Mapping[str, Any]],
    "budget": Mapping[str, Any],
    "other_noise": float | None,
    "episodes": Mapping[str, tuple[int, ...]],
    "calls": Mapping[str, int],
    "skipped": Mapping[str, str],
    "told": Mapping[str, str],
    "frontier": tuple[Mapping[str, Any], ...],
}
_TRIED: Mapping[str, Any] = {
    "name": str,
    "told": str,
    "distance": float,
    "interval": tuple[float, ...],
    "milliseconds": float,
    "worst": float,
    "near": bool,
}


def check_record(record: Value) -> None:
    """Raise ArtifactError unless what commands read of a calibration record is of its type, where it is there."""
    members = record.members()
    _check(members, _RECORD)
    if "budget" in members:
        _check(members["budget"].members(), dict.fromkeys(_BUDGET, float | None))
    for score in members["plans"].members().values() if "plans" in members else ():
        _check(score.members(), dict.fromkeys(_SCORE, float | None))
    for tried in members["frontier"].items() if "frontier" in members else ():
        _check(tried.members(), _TRIED)


def _check(members: Mapping[str, Value], kinds: Mapping[str, Any]) -> None:
    for name in members.keys() & kinds.keys():
        read_as(kinds[name], members[name])
