"""Streams of a batch that follow one plan go through the denoising loop together, in ONNX.

    for each different plan:                                             Loop
        take what belongs to the streams that follow it
        samples of these streams = the denoising loop (``loop``)
        residuals that later calls may read -> a row for each stream and cell

A schedule is one plan for all streams, so this loop runs once; so it does for one stream, whatever its plan.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from onnx import ModelProto, TensorProto

from ..core.coercion import Arrays
from ..ir.program import Program
from .contexts import Contexts, StreamContexts
from .graph_writer import GraphWriter, sequence, tensor
from .loop import GROUP, DenoisingLoop, LoopInputs
from .plan import INT64, ExecutedPlans, lower_plan


def write_streams(
    main: GraphWriter,
    program: Program,
    models: Mapping[str, ModelProto],
    weights: Arrays,
    contexts: Contexts,
    plans: ExecutedPlans,
    inputs: LoopInputs,
    keep: str,
) -> tuple[str, str, str]:
    """Write the loop over plans, with all that is in it.

    Args:
        keep: bool [K, N]: computed residuals that later calls may read.

    Returns:
        Names of values after the loop: the sample [B, T, D]; residuals that were computed and are to be kept, [new
        rows, A, C] as ``LoopInputs.rows``; and int64 [new rows], what each of them is of, as
        ``stream * K * N + k * N + b``.
    """
    count = main.op("Shape", plans.different, start=0, end=1)
    carried = [inputs.initial, main.op("SequenceEmpty"), main.op("SequenceEmpty", dtype=INT64)]
    # The body, of the streams of one plan, carries all samples, and sequences of rows and of their cells.
    w = main.inner()
    i, on, samples, rows, cells = (w.fresh(n) for n in ("i", "on", "samples", "rows", "cells"))
    steps, groups = program.spec.sampler.steps, [block.group for block in program.blocks]
    members = w.op("Reshape", w.op("NonZero", w.op("Equal", plans.which, i)), w.constant([-1]))
    plan = lower_plan(w, w.op("Gather", plans.different, i), groups, steps, GROUP)
    loop = DenoisingLoop(w, program, models, weights, StreamContexts(w, contexts, members))
    far = w.op("Cast", w.op("Gather", plans.far, i), to=TensorProto.BOOL)
    sample, residuals = loop.write(plan, _of_members(w, _uncorrected(w, inputs, far), members))
    every = w.op("ScatterND", samples, w.op("Unsqueeze", members, w.constant([1])), sample)

    computed, kept = (w.op("Reshape", flags, w.constant([-1])) for flags in (plan.computed, keep))
    chosen = w.op("Compress", residuals, w.op("Compress", kept, computed), axis=0)
    cell = w.op("NonZero", w.op("And", computed, kept))  # [1, new cells]
    first = w.op("Mul", members, w.constant(steps * len(groups)))
    numbers = w.op("Add", w.op("Transpose", cell, perm=[1, 0]), first)  # [new cells, S]
    before, after = (w.constant([n]) for n in residual_sizes(program))
    sizes = [w.op("Shape", cell, start=1), before, w.op("Shape", members), after]
    by_stream = w.op("Reshape", chosen, w.op("Concat", *sizes, axis=0), allowzero=1)
    by_stream = w.op("Transpose", by_stream, perm=[0, 2, 1, 3])
    flat = w.op("Reshape", numbers, w.constant([-1]))
    shape = w.op("Concat", w.op("Shape", flat), before, after, axis=0)
    new = w.op("Reshape", by_stream, shape, allowzero=1)
    more = [w.op("SequenceInsert", rows, new), w.op("SequenceInsert", cells, flat)]
    going_on = w.op("Identity", on)
    results = [tensor(going_on, np.bool_), tensor(every, np.float32), sequence(more[0]), sequence(more[1], np.int64)]
    given = [tensor(i, np.int64, []), tensor(on, np.bool_, []), tensor(samples, np.float32)]
    body = w.graph("streams_of_one_plan", results, [*given, sequence(rows), sequence(cells, np.int64)])
    count = main.op("Reshape", count, main.constant(np.zeros(0)))
    sample, *kept_ones = main.ops("Loop", [count, "", *carried], len(carried), body=body)
    new_rows, new_cells = (main.op("ConcatFromSequence", each, axis=0) for each in kept_ones)
    return sample, new_rows, new_cells


def _uncorrected(w: GraphWriter, inputs: LoopInputs, far: str) -> LoopInputs:
    """Without the matrices and jumps of a correction where streams are far outside; offsets are without already."""
    jumps = None if inputs.jumps is None else w.op("Where", far, w.constant(-1), inputs.jumps)
    return replace(inputs, update=w.op("Where", far, inputs.plain, inputs.update), jumps=jumps)


def _of_members(w: GraphWriter, inputs: LoopInputs, members: str) -> LoopInputs:
    def of(value: str, axis: int) -> str:
        return w.op("Gather", value, members, axis=axis)

    memory, condition = inputs.memory, inputs.condition if inputs.jumps is not None else None
    if condition is not None:
        condition = of(condition, 0)
    return replace(
        inputs,
        initial=of(inputs.initial, 0),
        offset=of(inputs.offset, 2),
        history=of(inputs.history, 1),
        memory=None if memory is None else of(memory, 1),
        index=of(inputs.index, 2),
        condition=condition,
    )


def residual_sizes(program: Program) -> tuple[int, int]:
    """A and C: how many numbers a residual of one stream has before and after the axis of streams."""
    type_ = program.blocks[0].type
    axis, sizes = type_.batch_axis, type_.at(1)
    assert axis is not None
    return math.prod(sizes[:axis]), math.prod(sizes[axis + 1 :])
