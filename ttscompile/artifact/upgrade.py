"""The manifest of the schema before the present one, as JSON of the present one. ``docs/stability.md`` promises one."""

from collections.abc import Mapping
from typing import Any

from ..core.plan import DENSE, FULL, ORIGINAL
from ..errors import ArtifactError
from ..ir.pieces import part_of
from .strict_json import REMEDY

_DISTILLED, _WARM = "distilled", "warm"


def upgraded(document: Mapping[str, Any], where: str) -> dict[str, Any]:
    """What a manifest of schema 10, without its checksum, says in schema 11; its identities stay those of before.

    There an artifact had one loop, which may be another than the policy was trained to run in; all plans had the
    artifact's precision, and reused tokens in one way; and beside them stood how many steps a warm start takes, and
    what the precision does to actions.
    """
    try:
        return _upgraded(document)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        problem = f"not the manifest of an artifact of schema 10 ({type(error).__name__}: {str(error)[:100]})"
        raise ArtifactError(f"{where}: {problem}. {REMEDY}") from error


def _upgraded(document: Mapping[str, Any]) -> dict[str, Any]:
    new = {key: value for key, value in document.items() if key not in ("distilled", "reuse", "warm")}
    distilled, reuse, warm, precision = (document[key] for key in ("distilled", "reuse", "warm", "precision"))
    common: dict[str, Any] = {
        "loop": ORIGINAL,
        "weights": ORIGINAL,
        "precision": {} if precision is None else dict.fromkeys(_kept(precision), precision["name"]),
        "tokens": None if reuse is None else {key: reuse[key] for key in ("threshold", "refresh")},
        "otherwise": None,
    }
    plans = {
        name: {**common, **plan, "weights": _DISTILLED if name == _DISTILLED else ORIGINAL}
        for name, plan in document["plans"].items()
    }
    default, computed = document["default_plan"], {"kind": "all", "sparsity": 0.0, "flops_sparsity": 0.0}
    if common["precision"] or common["tokens"]:  # what was called dense had these, too
        full = _free(FULL, plans)
        plans[full] = {**common, **computed}
        default = full if default == DENSE else default
    starts = {}
    if warm is not None:
        loop = f"{ORIGINAL}-last-{warm['last_steps']}"
        starts[loop] = {"loop": ORIGINAL, "steps": warm["last_steps"]}
        plans[_free(_WARM, plans)] = {**common, **computed, "loop": loop, "otherwise": default}
    return {
        **new,
        "schema_version": document["schema_version"] + 1,
        "spec": {**document["spec"], "loops": {}},
        "plans": plans,
        "default_plan": default,
        "loop_pruners": {},
        "starts": starts,
        "weights": {} if distilled is None else {_DISTILLED: distilled},
        "precision": None if precision is None else _without_measurement(precision),
    }


def _free(name: str, plans: Mapping[str, Any]) -> str:
    return next(each for each in (name, *(f"{name}-{i}" for i in range(len(plans)))) if each not in plans)


def _without_measurement(precision: Mapping[str, Any]) -> dict[str, Any]:
    own = _kept(precision)
    left = [part for part, measured in precision["parts"].items() if part not in own and measured is None]
    return {**{key: precision[key] for key in ("name", "weights", "models")}, "asked": left}


def _kept(precision: Mapping[str, Any]) -> list[str]:
    """The parts that have models of their own, as ``PrecisionRecord.kept``."""
    own = {part_of(piece) for piece in precision["models"]}
    return [part for part in precision["parts"] if part in own]
