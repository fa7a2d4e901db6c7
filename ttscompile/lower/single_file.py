"""One ONNX model that is the whole sparse call, for programs that have onnxruntime and nothing of ours.

    observation -> normalise -> condition and step values -.
    plan, rollout_index -> coefficients --------------------+-> loop over steps -> unnormalise -> action, action_pred
    initial_noise, step_noise, rollout_rows ----------------'                  '-> rollout_rows_next, .._index_next

All B streams of a batch follow one plan. For K steps and N blocks the inputs are, with the shapes of the policy:

======================= =================== ==========================================================================
(keys of observations)  ``[B, ...]``        as the policy's user has them, not normalised
``initial_noise``       float32 [B,T,D]     the sample at step 0
``step_noise``          float32 [K,B,T,D]   only if the sampler is stochastic
``plan``                int8 [K,N]          0 COMPUTE, 1 FORWARD, 2 TIMESTEP, 3 ROLLOUT; a plan that is no schedule of
                                            the artifact's comes from its pruner, which is not in the file
``rollout_rows``        float32 [R,...]     residuals of earlier calls of the episode; R = 0 in its first call
``rollout_index``       int64 [K,N]         which row is the residual of a cell; -1 where there is none
``rollout_keep``        bool [K,N]          residuals that later calls of the episode may read; none for plans without
                                            ROLLOUT, and the cache stays empty
======================= =================== ==========================================================================

A schedule that has a correction wants it as further inputs, which ``Correction.inputs`` gives: ``correction``,
``correction_bias`` and ``correction_anchors``, if it reads the observation ``correction_reading`` and
``correction_observed``, and if it has jumps ``correction_jumps``, ``correction_inner``, ``correction_middle`` and
``correction_outer``. Inputs that are left out correct nothing. onnxruntime warns, when it loads the file, that these
have values and can be overridden. The outputs are

======================= =================== ==========================================================================
``action``              float32 [B,Ta,Da]   what to execute
``action_pred``         float32 [B,T,Da]    the whole chunk
``executed_plan``       int8 [K,N]          the plan with a dense step 0, and with TIMESTEP for every ROLLOUT of what
                                            the cache does not have: ``legalize`` in ONNX
``rollout_rows_next``   float32 [R',...]    the next call's ``rollout_rows``
``rollout_index_next``  int64 [K,N]         the next call's ``rollout_index``
======================= =================== ==========================================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from onnx import ModelProto, ValueInfoProto, helper

from ..core.correction import (
    ANCHORS,
    CORRECTION,
    CORRECTION_BIAS,
    FEATURES,
    HIDDEN,
    HISTORY,
    INNER,
    JUMPS,
    MIDDLE,
    OBSERVED,
    OUTER,
    READING,
    may_jump,
    no_correction,
    numbers_of,
)
from ..core.spec import ORIGINAL, PolicySpec
from ..core.update import columns, diagonals, rows
from ..errors import LoweringError
from ..ir.graph import TensorType
from ..ir.pieces import ADVANCE, of_loop
from ..ir.program import Program
from .contexts import Contexts
from .graph_writer import GraphWriter, Weights, tensor
from .loop import GROUP, DenoisingLoop, Jumps, LoopInputs
from .onnx_model import opsets, own_model
from .plan import LoweredPlan, lower_plan

LARGEST = 2**31 - 1
"""Bytes of a file that protobuf reads."""


def lower_single_file(
    program: Program, models: Mapping[str, ModelProto], weights: Weights, loop: str = ORIGINAL
) -> ModelProto:
    """The model of the whole call in one of the program's loops, with its weights inside.

    Args:
        program: after all passes.
        models: from ``lower_program``; blocks may be of another precision.
        weights: values of the constants of these models.
        loop: name of the loop.

    Raises:
        SpecError: there is no such loop.
        LoweringError: an observation has the name of another input or output; the residual stream changes its type; a
            context cannot be repeated for a batch; or the file would have 2 GB.
    """
    program = program.in_loop(loop)
    models = {**models, ADVANCE: models.get(of_loop(ADVANCE, loop), models[ADVANCE])}
    spec, types = program.spec, sorted({str(block.type) for block in program.blocks})
    if len(types) != 1 or program.blocks[0].type.dtype != "float32":
        raise LoweringError(f"the residual stream changes its type, or is not float32: {types}. Convert without it.")
    inputs, outputs = _interface(spec, program.blocks[0].type, len(program.blocks))
    main = GraphWriter()
    streams = main.op("Shape", "initial_noise", start=0, end=1)
    observations = {key: _normalized(main, key, spec) for key in spec.observations}
    contexts = Contexts(main, program.pieces, models, weights, observations, streams, spec.sampler.steps)
    groups = [block.group for block in program.blocks]
    plan = lower_plan(main, "plan", "rollout_index", groups, spec.sampler.steps, GROUP)
    one = main.op("Concat", main.op("Shape", "rollout_rows", start=0, end=1), _width(main), axis=0)
    stored = main.op("Reshape", "rollout_rows", one, allowzero=1)
    given = no_correction(spec.sampler.steps, spec.sample)
    for name, array in ((ANCHORS, given.anchors), (CORRECTION, given.weights), (CORRECTION_BIAS, given.bias)):
        inputs.append(tensor(name, array.dtype, array.shape))
        main.default(name, array)
    update, offset = _update(main, spec, streams)
    condition = None
    if numbers := numbers_of(program.pieces.condition.types()[name].at(1) for name in program.pieces.features):
        condition = contexts.condition()
        inputs += _condition_inputs(main, spec, numbers)
        offset = main.op("Add", offset, _observed(main, spec, condition))
    jumps = None
    if may_jump(spec.sample):
        inputs += _jump_inputs(main, spec, numbers)
        jumps = Jumps(JUMPS, INNER, MIDDLE, OUTER, condition)
    history, memories = _zeros(main, spec, streams, HISTORY), spec.sampler.memories
    memory = _zeros(main, spec, streams, memories) if memories else None
    writer = DenoisingLoop(main, program, models, weights, contexts)
    values = LoopInputs("initial_noise", offset, update, ANCHORS, history, memory, stored, "rollout_index", jumps)
    sample, residuals = writer.write(plan, values)
    if (bound := spec.sampler.bound) is not None:  # without a correction no number is beyond it
        sample = main.op("Clip", sample, *(main.constant(end, np.float32) for end in (-bound, bound)))
    _write_actions(main, sample, spec)
    main.rename(plan.executed, "executed_plan")
    _write_cache(main, plan, stored, residuals, (spec.sampler.steps, len(groups)))
    model = own_model(main.graph("ttscompile", outputs, inputs), opsets(models.values()))
    if (size := model.ByteSize()) > LARGEST:
        what = f"the single file would have {size / 1e9:.1f} GB; an ONNX file holds at most 2"
        raise LoweringError(f"{what}. Convert without the single file and use the artifact.")
    return model


def _interface(spec: PolicySpec, stream: TensorType, count: int) -> tuple[list[ValueInfoProto], list[ValueInfoProto]]:
    """Inputs and outputs; see the top of the file."""
    (horizon, channels), chunk, steps = spec.sample, spec.chunk, spec.sampler.steps
    row = [n if isinstance(n, int) else str(n) for n in stream.shape]
    inputs = [tensor(key, each.dtype, ["B", *each.shape]) for key, each in spec.observations.items()]
    own = [tensor("initial_noise", np.float32, ["B", horizon, channels])]
    if spec.sampler.stochastic:
        own.append(tensor("step_noise", np.float32, [steps, "B", horizon, channels]))
    own += [
        tensor("plan", np.int8, [steps, count]),
        tensor("rollout_rows", np.float32, ["R", *row]),
        tensor("rollout_index", np.int64, [steps, count]),
        tensor("rollout_keep", np.bool_, [steps, count]),
    ]
    outputs = [
        tensor("action", np.float32, ["B", chunk.stop - chunk.start, chunk.action_dim]),
        tensor("action_pred", np.float32, ["B", horizon, chunk.action_dim]),
        tensor("executed_plan", np.int8, [steps, count]),
        tensor("rollout_rows_next", np.float32, ["R_next", *row]),
        tensor("rollout_index_next", np.int64, [steps, count]),
    ]
    if clash := sorted(set(spec.observations) & {value.name for value in (*own, *outputs)}):
        what = f"the observations {clash} have names of the single file's own inputs or outputs"
        raise LoweringError(f"{what}. Rename them, or convert without the single file.")
    return [*inputs, *own], outputs


def _normalized(main: GraphWriter, key: str, spec: PolicySpec) -> str:
    """An observation as the network wants it."""
    each = spec.observations[key]
    if each.normalizer is None:
        return key
    value = key if each.dtype == "float32" else main.op("Cast", key, to=helper.np_dtype_to_tensor_dtype(np.dtype("f4")))
    scaled = main.op("Mul", value, main.constant(each.normalizer.scale, np.float32))
    return main.op("Add", scaled, main.constant(each.normalizer.offset, np.float32))


def _update(main: GraphWriter, spec: PolicySpec, streams: str) -> tuple[str, str]:
    """``ttscompile.core.update`` in ONNX: matrices of all steps, and offsets of all steps."""
    (horizon, dimensions), sampler = spec.sample, spec.sampler
    high, wide = rows(sampler, horizon), columns(sampler, horizon)
    places = np.zeros((sampler.steps, 1, high // horizon, 1, wide // horizon, 1), np.float32)
    for (read, written), column in diagonals(sampler).items():
        places[:, 0, read, 0, written, 0] = column
    each = main.constant(np.eye(horizon)[:, None], np.float32)
    own = main.op("Mul", main.constant(places, np.float32), each)
    own = main.op("Reshape", own, main.constant([sampler.steps, 1, high, wide]))
    pads = [0, 0, 0, 0, 0, 0, high - FEATURES * horizon, wide - horizon]  # the correction's weights are at the top left
    update = main.op("Add", main.op("Pad", CORRECTION, main.constant(pads)), own)
    sizes = main.constant([sampler.steps, dimensions]), streams, main.constant([horizon])
    offset = main.op("Expand", CORRECTION_BIAS, main.op("Concat", *sizes, axis=0))
    if sampler.stochastic:
        noise = main.op("Transpose", "step_noise", perm=[0, 3, 1, 2])
        scale = main.constant(sampler.noise_to_next[:, None, None, None], np.float32)
        offset = main.op("Add", main.op("Mul", noise, scale), offset)
    return update, offset


def _condition_inputs(main: GraphWriter, spec: PolicySpec, numbers: int) -> list[ValueInfoProto]:
    """The inputs of a correction that reads N numbers of the condition; they read one that adds nothing by default."""
    (horizon, dimensions), steps = spec.sample, spec.sampler.steps
    main.default(READING, np.zeros((numbers, 1), np.float32))
    main.default(OBSERVED, np.zeros((1, steps, dimensions, horizon), np.float32))
    return [
        tensor(READING, np.float32, [numbers, "F"]),
        tensor(OBSERVED, np.float32, ["F", steps, dimensions, horizon]),
    ]


def _jump_inputs(main: GraphWriter, spec: PolicySpec, numbers: int) -> list[ValueInfoProto]:
    """The inputs of jumps that read N numbers of the condition; by default there are none."""
    steps, chunk = spec.sampler.steps, math.prod(spec.sample)
    main.default(JUMPS, np.full(steps, -1, np.int64))
    inputs = [tensor(JUMPS, np.int64, [steps])]
    layers = {INNER: (numbers + HISTORY * chunk + 1, HIDDEN), MIDDLE: (HIDDEN + 1, HIDDEN), OUTER: (HIDDEN + 1, chunk)}
    for name, shape in layers.items():
        main.default(name, np.zeros((1, *shape), np.float32))
        inputs.append(tensor(name, np.float32, ["J", *shape]))
    return inputs


def _observed(main: GraphWriter, spec: PolicySpec, condition: str) -> str:
    """``Correction.from_condition`` in ONNX: ``[K, D, B, T]`` of the condition's numbers ``[B, N]``."""
    (horizon, dimensions), steps = spec.sample, spec.sampler.steps
    rows = main.op("Reshape", OBSERVED, main.constant([-1, steps * dimensions * horizon]))
    added = main.op("MatMul", main.op("MatMul", condition, READING), rows)
    split = main.op("Reshape", added, main.constant([-1, steps, dimensions, horizon]))
    return main.op("Transpose", split, perm=[1, 2, 0, 3])


def _zeros(main: GraphWriter, spec: PolicySpec, streams: str, count: int) -> str:
    """``[D, B, count * T]``."""
    horizon, dimensions = spec.sample
    shape = main.op("Concat", main.constant([dimensions]), streams, main.constant([count * horizon]), axis=0)
    return main.op("ConstantOfShape", shape)


def _width(main: GraphWriter) -> str:
    """E, int64 ``[1]``: how many numbers a residual has."""
    return main.op("ReduceProd", main.op("Shape", "rollout_rows", start=1), keepdims=1)


def _write_actions(main: GraphWriter, sample: str, spec: PolicySpec) -> None:
    chunk = spec.chunk
    predicted = main.op("Slice", sample, *(main.constant([n]) for n in (0, chunk.action_dim, 2)))
    if chunk.normalizer is not None:
        predicted = main.op("Sub", predicted, main.constant(chunk.normalizer.offset, np.float32))
        predicted = main.op("Div", predicted, main.constant(chunk.normalizer.scale, np.float32))
    main.rename(predicted, "action_pred")
    main.rename(main.op("Slice", predicted, *(main.constant([n]) for n in (chunk.start, chunk.stop, 1))), "action")


def _write_cache(main: GraphWriter, plan: LoweredPlan, stored: str, computed: str, lattice: tuple[int, int]) -> None:
    """The next call's rollout cache: rows that were ``stored`` and not computed anew, then those ``computed``.

    The latter are residuals of the computed cells, in order; the lattice is K and N.
    """
    keep, index, anew = (
        main.op("Reshape", value, main.constant([-1])) for value in ("rollout_keep", "rollout_index", plan.computed)
    )
    known = main.op("And", main.op("GreaterOrEqual", index, main.constant(0)), main.op("Not", anew))
    old_cells = _true(main, main.op("And", known, keep))
    new_cells = _true(main, main.op("And", anew, keep))
    old_rows = main.op("Gather", stored, main.op("Gather", index, old_cells))
    new_rows = main.op("Compress", computed, main.op("Compress", keep, anew), axis=0)
    rows = main.op("Concat", old_rows, new_rows, axis=0)
    shape = main.op("Concat", main.op("Shape", rows, start=0, end=1), main.op("Shape", "rollout_rows", start=1), axis=0)
    main.rename(main.op("Reshape", rows, shape, allowzero=1), "rollout_rows_next")
    cells = main.op("Concat", old_cells, new_cells, axis=0)
    numbers = main.op("Range", main.constant(0), main.op("Size", cells), main.constant(1))
    nothing = main.constant(np.full(lattice[0] * lattice[1], -1))
    merged = main.op("ScatterElements", nothing, cells, numbers, axis=0)
    main.rename(main.op("Reshape", merged, main.constant(lattice)), "rollout_index_next")


def _true(main: GraphWriter, flags: str) -> str:
    """Indices of what is true in a vector."""
    return main.op("Reshape", main.op("NonZero", flags), main.constant([-1]))
