"""Schedules and corrections by name, put into an artifact as plans of its default's loop and precision."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ttscompile.artifact import load_artifact
from ttscompile.artifact.manifest import Manifest
from ttscompile.artifact.write import update_plans
from ttscompile.core.correction import Correction
from ttscompile.core.plan import DENSE, FULL, Plan
from ttscompile.ir.pieces import PRUNER


def base_plan(path: str | Path) -> Plan:
    """The plan that computes every cell of what the artifact was converted to."""
    plans = load_artifact(Path(path)).plans
    return plans.get(FULL, plans[DENSE])


def store_schedules(
    path: str | Path,
    pruner_weights: Mapping[str, Any] | None,
    schedules: Mapping[str, np.ndarray],
    default_plan: str,
    record: Mapping[str, Any],
    *,
    corrections: Mapping[str, Correction] | None = None,
    **more: Any,
) -> Manifest:
    """Exactly these schedules, and with ``pruner_weights`` one plan of the pruner.

    That plan has the name ``default_plan``, or ``pruner`` where ``default_plan`` is a schedule or ``dense``.
    """
    base, own = base_plan(path), corrections or {}
    plans = {name: replace(base, cells=cells, correction=own.get(name)) for name, cells in schedules.items()}
    if pruner_weights is not None:
        name = PRUNER if default_plan in {DENSE, *plans} else default_plan
        plans[name] = replace(base, cells=None, correction=own.get(name))
    if FULL in load_artifact(Path(path)).plans:
        plans = {FULL: base, **plans}
    return update_plans(path, plans, default_plan, record, pruner_weights=pruner_weights, pruner_loop=base.loop, **more)
