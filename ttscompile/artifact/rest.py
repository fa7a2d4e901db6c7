"""The artifact of the last steps of a loop, which share files and weights with the whole one."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from ..core.lattice import dense_plan
from ..core.rest import Start, rest_of
from ..ir.flops import graph_flops
from ..ir.pieces import STEP
from .load import Artifact
from .manifest import WARM, PlanRecord


def with_last_steps(artifact: Artifact, steps: int) -> tuple[Artifact, Start]:
    """The artifact of the last steps of the loop alone, and what they begin with. Its files are the same.

    Its only plan beside ``dense`` computes all cells, too: ``warm``. Of a plan of the artifact a runtime keeps what
    later calls can read, which is nothing here; of ``dense`` it keeps everything.

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
        plans={WARM: PlanRecord(kind="schedule", sparsity=0.0, flops_sparsity=0.0)},
        default_plan=WARM,
        calibration=None,
        distilled=None,
        warm=None,
    )
    return replace(
        artifact,
        manifest=rest,
        tables=MappingProxyType({name: rows[start.skipped :] for name, rows in artifact.tables.items()}),
        schedules=MappingProxyType({WARM: dense_plan(steps, len(own.blocks))}),
        corrections=MappingProxyType({}),
        distilled=MappingProxyType({}),
    ), start
