"""The artifact of the last steps of a loop, which share files and weights with the whole one."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from ..core.rest import Start, rest_of
from ..ir.flops import graph_flops
from ..ir.pieces import STEP
from .load import Artifact
from .manifest import DENSE


def with_last_steps(artifact: Artifact, steps: int) -> tuple[Artifact, Start]:
    """The artifact of the last steps of the loop alone, dense, and what they begin with. Its files are the same.

    Args:
        artifact: of the whole loop.
        steps: how many are left, fewer than all.

    Raises:
        SpecError: there are no fewer steps, or the sampler's table does not tell what they begin with
            (``core.rest.rest_of``).
    """
    own = artifact.manifest
    table, start = rest_of(own.spec.sampler, steps)
    values = graph_flops(artifact.graph(STEP)) * start.skipped if STEP in own.pieces else 0
    flops = replace(own.flops, dense=own.flops.dense * steps // own.steps, prologue=own.flops.prologue - values)
    rest = replace(
        own,
        spec=replace(own.spec, sampler=table),
        flops=flops,
        plans={},
        default_plan=DENSE,
        calibration=None,
        distilled=None,
        warm=None,
    )
    return replace(
        artifact,
        manifest=rest,
        tables=MappingProxyType({name: rows[start.skipped :] for name, rows in artifact.tables.items()}),
        schedules=MappingProxyType({}),
        corrections=MappingProxyType({}),
        distilled=MappingProxyType({}),
    ), start
