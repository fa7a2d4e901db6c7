"""Plans on the lattice of steps and blocks: what a cell reads, what is legal, what it costs.

Everything here is numpy and pure. ``docs/design.md`` section 2 has the semantics in words; the reference runtime
executes them literally, and ``origins`` is the same meaning solved ahead of time, for lowering.
"""

import enum
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import IllegalPlanError
from .coercion import listed

PlanArray = npt.NDArray[np.int8]
BoolArray = npt.NDArray[np.bool_]


class Source(enum.IntEnum):
    """Where the residual of one cell comes from.

    What runs in every call gives numpy the ``value``: a member makes numpy look for attributes, in Python, which takes
    five times as long and loses an interrupt (Ctrl-C) that comes meanwhile.
    """

    COMPUTE = 0
    FORWARD = 1
    TIMESTEP = 2
    ROLLOUT = 3


UNWRITTEN = -1
"""In ``origins``: the cell reads a residual that was never computed."""


@dataclass(frozen=True)
class Origins:
    """Which computed residual every cell adds.

    Attributes:
        cell: int32 ``[K, blocks]``; flat index ``k * blocks + b`` of the cell of *this* call whose computed residual
            is added, or ``UNWRITTEN``. For a cell in ``rollout`` it is the index of the rollout entry instead.
        rollout: bool ``[K, blocks]``; the cell reads the rollout cache of an earlier call.
    """

    cell: npt.NDArray[np.int32]
    rollout: BoolArray


def check_plan(plan: npt.ArrayLike, steps: int, blocks: int, streams: int) -> PlanArray:
    """A plan ``[K, blocks]`` or ``[B, K, blocks]`` of any integer dtype as int8 ``[B, K, blocks]``; or refused."""
    given = _sources(plan)
    array = np.broadcast_to(given, (streams, *given.shape)) if given.ndim == 2 else given
    if array.shape != (streams, steps, blocks):
        expected = f"[K, blocks] = ({steps}, {blocks}) or [B, K, blocks] = ({streams}, {steps}, {blocks})"
        raise IllegalPlanError(f"plan has shape {given.shape}; expected {expected}.")
    return np.ascontiguousarray(array, dtype=np.int8)


def _sources(plan: npt.ArrayLike) -> npt.NDArray[Any]:
    """A copy of a plan of any shape and integer dtype, which holds nothing but sources."""
    array = listed(plan, "plan", IllegalPlanError, "int8").copy()
    if array.dtype.kind not in "iu":
        raise IllegalPlanError(
            f"plan has dtype {array.dtype}; expected an integer array of ttscompile.Source. Use plan.astype(np.int8)."
        )
    if array.size and (array.min() < 0 or array.max() > 3):
        found = f"{int(array.min())}..{int(array.max())}"
        raise IllegalPlanError(f"plan holds values {found}; expected ttscompile.Source, 0..3.")
    return array


def origins(plan: PlanArray, groups: Sequence[int]) -> Origins:
    """Resolve every cell of one stream's plan to the computed residual that it adds.

    Args:
        plan: int8 ``[K, blocks]``.
        groups: for each block the number of its FORWARD group (one kind and one shape).

    Returns:
        The origins; cells that read nothing have ``UNWRITTEN``. Rollout cells are resolved to their own index
        whether or not the rollout cache holds them: that depends on the episode.
    """
    rollout = plan == Source.ROLLOUT.value  # numpy takes five times as long to compare with the enum itself
    computed, own = np.full(plan.shape, UNWRITTEN, np.int32), np.flatnonzero(plan == Source.COMPUTE.value)
    computed.reshape(-1)[own] = own
    # The newest residual has the largest index. A reused cell adds none to those that it takes the newest of.
    cell = np.maximum.accumulate(computed, axis=0)
    own = np.flatnonzero(rollout)
    cell.reshape(-1)[own] = own
    forward = np.flatnonzero(plan == Source.FORWARD.value)
    if len(forward):
        order, stop = np.argsort(groups, kind="stable"), 0  # the blocks of a group side by side
        newest = computed.take(order, axis=1)
        for group in sorted(set(groups)):
            start, stop = stop, stop + groups.count(group)
            part = newest[:, start:stop]
            part[:] = np.maximum.accumulate(part.reshape(-1)).reshape(part.shape)
        cell.reshape(-1)[forward] = newest.take(np.argsort(order), axis=1).reshape(-1)[forward]
    return Origins(cell, rollout)


def illegal_cells(plan: PlanArray, groups: Sequence[int], written: BoolArray) -> BoolArray:
    """Cells of one stream's plan that may not be executed, bool ``[K, blocks]``."""
    resolved = origins(plan, groups)
    illegal: BoolArray = np.where(resolved.rollout, ~written, resolved.cell == UNWRITTEN)
    illegal[0] |= plan[0] != Source.COMPUTE.value
    return illegal


def require_legal(plans: PlanArray, groups: Sequence[int], written: BoolArray) -> None:
    """Raise IllegalPlanError if any stream's plan, of int8 ``[B, K, blocks]``, is illegal.

    ``groups`` has the FORWARD group of each block; ``written``, bool of the plans' shape, which rollout entries exist.
    """
    for stream, (plan, cells) in enumerate(zip(plans, written, strict=True)):
        bad = np.argwhere(illegal_cells(plan, groups, cells))
        if len(bad):
            step, block = bad[0].tolist()
            what = f"its {Source(int(plan[step, block])).name} residual was never computed"
            what = "step 0 must be dense" if step == 0 else what
            raise IllegalPlanError(
                f"plan of stream {stream} is illegal at step {step}, block {block} ({what});"
                f" {len(bad)} illegal cells in all. Pass it through ttscompile.legalize first, or use plan='dense'"
                " for the first call after reset()."
            )


def legalize(plan: PlanArray, groups: Sequence[int], written: BoolArray) -> tuple[PlanArray, int]:
    """Replace illegal reads: step 0 becomes COMPUTE, ROLLOUT becomes TIMESTEP, anything still unread COMPUTE.

    Pure: neither argument is changed. Works on one plan or on one a stream.

    Args:
        plan: int8 ``[K, blocks]`` or ``[B, K, blocks]``.
        groups: FORWARD group of each block.
        written: bool, of the plan's shape; the rollout entries that exist.

    Returns:
        A legal plan of the same shape, and the number of cells that were replaced.

    Raises:
        IllegalPlanError: the plan holds something else than sources, or ``written`` is not of its shape.
    """
    sources = _sources(plan).astype(np.int8)
    known = listed(written, "written", IllegalPlanError, "bool").astype(np.bool_)
    if sources.ndim not in (2, 3) or len(groups) != sources.shape[-1] or known.shape != sources.shape:
        expected = "plan and written of the same shape, [K, blocks] or [B, K, blocks], and a group for each block"
        raise IllegalPlanError(f"expected {expected}; found {sources.shape}, {known.shape} and {len(groups)} groups.")
    legal = without_illegal_reads(sources, known)
    return legal, int(np.count_nonzero(legal != sources))


def without_illegal_reads(plan: PlanArray, written: BoolArray) -> PlanArray:
    """What ``legalize`` makes of plans ``[..., K, blocks]`` that hold sources, and were checked to fit."""
    legal = plan.copy()
    legal[..., 0, :] = Source.COMPUTE.value
    legal[(legal == Source.ROLLOUT.value) & ~written] = Source.TIMESTEP.value
    # With step 0 dense every TIMESTEP and FORWARD read after it is written, so one sweep is enough.
    return legal


def dense_plan(steps: int, blocks: int) -> PlanArray:
    """The plan that computes everything, int8 ``[K, blocks]``."""
    return np.full((steps, blocks), Source.COMPUTE.value, dtype=np.int8)


def check_schedule(name: str, plan: npt.NDArray[Any], steps: int, blocks: int) -> None:
    """Raise IllegalPlanError unless this is a schedule of a loop: int8 ``[K, blocks]`` with a dense step 0."""
    if plan.dtype != np.int8 or plan.ndim != 2:
        found = f"{plan.dtype}{list(plan.shape)}"
        raise IllegalPlanError(f"schedule {name!r}: expected int8[{steps}, {blocks}]; found {found}.")
    try:
        check_plan(plan, steps, blocks, 1)
    except IllegalPlanError as error:
        raise IllegalPlanError(f"schedule {name!r}: {error}") from error
    if (plan[0] != Source.COMPUTE).any():
        raise IllegalPlanError(f"schedule {name!r}: expected COMPUTE in all of step 0; found {plan[0].tolist()}.")


def whole_steps_plan(steps: int, blocks: int, chosen: Iterable[int]) -> PlanArray:
    """Every block computed at the chosen steps, TIMESTEP elsewhere: int8 ``[K, blocks]``."""
    plan = np.full((steps, blocks), Source.TIMESTEP, dtype=np.int8)
    plan[list(chosen)] = Source.COMPUTE
    return plan


def uniform_plan(steps: int, blocks: int, full_steps: int) -> PlanArray:
    """The same with ``full_steps`` evenly spaced steps, step 0 among them."""
    return whole_steps_plan(steps, blocks, (step * steps // full_steps for step in range(full_steps)))


def sparsity(plan: PlanArray) -> float:
    """Share of the cells that are not COMPUTE."""
    return float(np.mean(plan != Source.COMPUTE))


def plan_flops(plan: PlanArray, block_flops: npt.ArrayLike) -> float:
    """FLOPs of the computed cells of one plan ``[K, blocks]``, given FLOPs of one evaluation of each block."""
    return float(((plan == Source.COMPUTE.value) * np.asarray(block_flops, dtype=np.float64)).sum())
