"""What the manifest says of plans and of their calibration."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.lattice import plan_flops, sparsity
from ..errors import ArtifactError
from ..ir.pieces import PRUNER
from .load import check_schedule
from .manifest import DENSE, Manifest, PlanRecord
from .strict_json import Value, dump_compact, parse

_PLAN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.%-]{0,63}")


def plan_records(
    manifest: Manifest,
    pruned: bool,
    schedules: Mapping[str, npt.NDArray[np.int8]],
    default_plan: str,
    record: Mapping[str, Any],
) -> dict[str, PlanRecord]:
    """Records of schedules and of the pruner's plan; see ``write.update_calibration``.

    Args:
        manifest: of the artifact.
        pruned: whether the pruner makes a plan.
        schedules: int8 ``[K, blocks]`` by name.
        default_plan: what it will be.
        record: of the calibration.

    Raises:
        ArtifactError: names that cannot be, or sparsities that are no shares.
        IllegalPlanError: a schedule that does not fit the policy.
    """
    plans = {}
    for name in sorted(schedules):
        if _PLAN_NAME.fullmatch(name) is None or name == DENSE:
            raise ArtifactError(f"schedule {name!r}: expected letters, digits and _ . % - and not 'dense'.")
        plan = np.asarray(schedules[name])
        check_schedule(name, plan, manifest)
        total = manifest.steps * sum(manifest.flops.blocks)
        weighed = 1 - plan_flops(plan, manifest.flops.blocks) / total if total else sparsity(plan)
        plans[name] = PlanRecord(kind="schedule", sparsity=sparsity(plan), flops_sparsity=weighed)
    if pruned:
        if manifest.stores.pruner is None:
            raise ArtifactError("the artifact has no pruner whose weights could be set. Convert the checkpoint again.")
        name = PRUNER if default_plan in {DENSE, *plans} else default_plan
        if name in plans or _PLAN_NAME.fullmatch(name) is None:
            raise ArtifactError(f"the pruner's plan cannot be called {name!r}. Give the schedule another name.")
        plans[name] = PlanRecord(PRUNER, _share(record, "sparsity"), _share(record, "flops_sparsity"))
    if default_plan not in {DENSE, *plans}:
        raise ArtifactError(f"default plan {default_plan!r}: expected one of {[DENSE, *plans]}.")
    return plans


def _share(record: Mapping[str, Any], key: str) -> float | None:
    return None if record.get(key) is None else Value(record[key], f"calibration record: {key}").share()


def calibration_record(record: Mapping[str, Any]) -> dict[str, Any]:
    """The record as it will be read back."""
    try:
        content = dump_compact(dict(record))
    except (TypeError, ValueError) as error:
        raise ArtifactError(f"calibration record: expected JSON; found {error}. Convert arrays to lists.") from error
    return {key: value.data for key, value in parse(content, "calibration record").members().items()}
