"""One ONNX model that is the whole sparse call, for programs that have onnxruntime and nothing of ours.

    observation -> normalise -> condition and step values -.
    plan, or the pruner's -> repair -> coefficients --------+-> loop over steps -> unnormalise -> action, action_pred
    initial_noise, step_noise, rollout_rows ----------------'                  '-> rollout_rows_next, .._index_next

Each stream of a batch may follow a plan of its own; those that follow one go through the loop together. Inputs and
outputs are in ``docs/howto/cpp.md``; ``runtimes.single_file.inputs_of`` gives what belongs to a plan of an artifact.
"""

import math
from collections.abc import Mapping

import numpy as np
from onnx import ModelProto, ValueInfoProto, helper

from ..core import correction
from ..core.coercion import Arrays
from ..core.envelope import CENTER, ENVELOPE, FAR, PLAIN
from ..core.lattice import Source
from ..core.spec import ORIGINAL, PolicySpec, Relative
from ..core.update import columns, diagonals, rows
from ..errors import LoweringError
from ..ir.graph import Graph
from ..ir.pieces import ADVANCE, PRUNER, USE_PRUNER, of_loop
from ..ir.program import Program
from .contexts import Contexts
from .graph_writer import GraphWriter, tensor
from .loop import LoopInputs
from .onnx_model import opsets, own_model
from .plan import ExecutedPlans, write_executed_plans
from .poses import write_absolute
from .streams import residual_sizes, write_streams

LARGEST = 2**31 - 1
"""Bytes of a file that protobuf reads."""


def lower_single_file(
    program: Program, models: Mapping[str, ModelProto], weights: Arrays, loop: str = ORIGINAL
) -> ModelProto:
    """The model of the whole call in one of the program's loops, with its weights inside; blocks may be in int8.

    Raises:
        SpecError: there is no such loop.
        LoweringError: an observation has the name of another input or output; the residual stream changes its type; a
            context cannot be repeated for a batch; or the file would have 2 GB.
    """
    weights = {**weights, **program.loop_weights.get(loop, {})}
    own = {piece: models.get(of_loop(piece, loop)) for piece in (ADVANCE, PRUNER)}
    models = {**models, **{piece: model for piece, model in own.items() if model is not None}}
    program = program.in_loop(loop)
    spec, types = program.spec, sorted({str(block.type) for block in program.blocks})
    stream = program.blocks[0].type
    if len(types) != 1 or stream.dtype != "float32" or stream.batch_axis is None:
        problem = f"the residual stream changes its type, or is not float32, or has no axis of streams: {types}"
        raise LoweringError(f"{problem}. Convert without it.")
    main = GraphWriter()
    inputs, outputs = write_interface(main, program, weights)
    streams = main.op("Shape", "initial_noise", start=0, end=1)
    observations = {key: _normalized(main, key, spec) for key in spec.observations}
    for key in spec.inputs.keys() - spec.observations:  # nothing is committed: the file takes no prefix
        sizes = main.op("Concat", streams, main.constant([1]), axis=0)
        observations[key] = main.op("Expand", main.constant([[0]]), sizes)
    contexts = Contexts(main, program.pieces, models, weights, observations, streams, spec.sampler.steps)
    lattice, pruner = (spec.sampler.steps, len(program.blocks)), None
    if program.pieces.pruner is not None:
        pruner = USE_PRUNER, contexts.logits
    condition = contexts.condition() if condition_numbers(program) else None
    far = _far(main, condition, streams)
    plans = write_executed_plans(main, "plan", "rollout_index", streams, lattice, pruner, far)
    update, plain = _update(main, spec)
    offset = _offset(main, spec, streams, condition, far)
    history, memories = _zeros(main, spec, streams, correction.HISTORY), spec.sampler.memories
    memory = _zeros(main, spec, streams, memories) if memories else None
    count = main.op("Shape", "rollout_rows", start=0, end=1)
    rows = main.op("Concat", count, main.constant(residual_sizes(program)), axis=0)
    rows = main.op("Reshape", "rollout_rows", rows, allowzero=1)
    values = LoopInputs(
        initial="initial_noise",
        offset=offset,
        update=update,
        plain=plain,
        anchors=correction.ANCHORS,
        history=history,
        memory=memory,
        rows=rows,
        index=main.op("Transpose", "rollout_index", perm=[1, 2, 0]),
        jumps=correction.JUMPS if correction.may_jump(spec.sample) else None,
        condition=condition,
    )
    sample, *kept = write_streams(main, program, models, weights, contexts, plans, values, "rollout_keep")
    bound = spec.sampler.bound
    if bound is not None:  # without a correction no number is beyond it
        sample = main.op("Clip", sample, *(main.constant(end, np.float32) for end in (-bound, bound)))
    _write_actions(main, main.op("Add", sample, plans.broken), spec)
    main.rename(plans.executed, "executed_plan")
    main.rename(plans.legalised, "legalised")
    _write_cache(main, plans, rows, *kept)
    model = own_model(main.graph("ttscompile", outputs, inputs), opsets(models.values()))
    if (size := model.ByteSize()) > LARGEST:
        what = f"the single file would have {size / 1e9:.1f} GB; an ONNX file holds at most 2"
        raise LoweringError(f"{what}. Convert without the single file and use the artifact.")
    return model


def _normalized(main: GraphWriter, key: str, spec: PolicySpec) -> str:
    each = spec.observations[key]
    if each.normalizer is None:
        return key
    value = key if each.dtype == "float32" else main.op("Cast", key, to=helper.np_dtype_to_tensor_dtype(np.dtype("f4")))
    scaled = main.op("Mul", value, main.constant(each.normalizer.scale, np.float32))
    return main.op("Add", scaled, main.constant(each.normalizer.offset, np.float32))


def _far(main: GraphWriter, condition: str | None, streams: str) -> str:
    """``core.envelope`` in ONNX: bool [B]; writes the output ``outside``."""
    if condition is None:
        outside = main.op("Expand", main.constant(0, np.float32), streams)
    else:
        away = main.op("Sub", main.op("MatMul", condition, ENVELOPE), CENTER)
        outside = main.op("ReduceL2", away, main.constant([1]), keepdims=0)
    far = main.op("Greater", outside, main.constant(FAR, np.float32))
    main.rename(outside, "outside")
    return far


def _offset(main: GraphWriter, spec: PolicySpec, streams: str, condition: str | None, far: str) -> str:
    """What all steps add to the sample, ``[K, D, B, T]``; without a correction where a stream is far outside."""
    (horizon, dimensions), sampler = spec.sample, spec.sampler
    sizes = main.constant([sampler.steps, dimensions]), streams, main.constant([horizon])
    offset = main.op("Expand", correction.CORRECTION_BIAS, main.op("Concat", *sizes, axis=0))
    if condition is not None:
        offset = main.op("Add", offset, _observed(main, spec, condition))
    of_stream = main.op("Reshape", far, main.constant([-1, 1]))
    offset = main.op("Where", of_stream, main.constant(0, np.float32), offset)
    if sampler.stochastic:
        noise = main.op("Transpose", "step_noise", perm=[0, 3, 1, 2])
        scale = main.constant(sampler.noise_to_next[:, None, None, None], np.float32)
        offset = main.op("Add", main.op("Mul", noise, scale), offset)
    return offset


def _update(main: GraphWriter, spec: PolicySpec) -> tuple[str, str]:
    """``ttscompile.core.update`` in ONNX: matrices of all steps, with the correction and without."""
    horizon, sampler = spec.sample[0], spec.sampler
    high, wide = rows(sampler, horizon), columns(sampler, horizon)
    places = np.zeros((sampler.steps, 1, high // horizon, 1, wide // horizon, 1), np.float32)
    for (read, written), column in diagonals(sampler).items():
        places[:, 0, read, 0, written, 0] = column
    each = main.constant(np.eye(horizon)[:, None], np.float32)
    own = main.op("Mul", main.constant(places, np.float32), each)
    own = main.op("Reshape", own, main.constant([sampler.steps, 1, high, wide]))
    # The correction's weights are at the top left.
    pads = [0, 0, 0, 0, 0, 0, high - correction.FEATURES * horizon, wide - horizon]
    return main.op("Add", main.op("Pad", correction.CORRECTION, main.constant(pads)), own), own


def _observed(main: GraphWriter, spec: PolicySpec, condition: str) -> str:
    """``Correction.from_condition`` in ONNX: ``[K, D, B, T]`` of the condition's numbers ``[B, N]``."""
    (horizon, dimensions), steps = spec.sample, spec.sampler.steps
    rows = main.op("Reshape", correction.OBSERVED, main.constant([-1, steps * dimensions * horizon]))
    added = main.op("MatMul", main.op("MatMul", condition, correction.READING), rows)
    split = main.op("Reshape", added, main.constant([-1, steps, dimensions, horizon]))
    return main.op("Transpose", split, perm=[1, 2, 0, 3])


def _zeros(main: GraphWriter, spec: PolicySpec, streams: str, count: int) -> str:
    """``[D, B, count * T]``."""
    horizon, dimensions = spec.sample
    shape = main.op("Concat", main.constant([dimensions]), streams, main.constant([count * horizon]), axis=0)
    return main.op("ConstantOfShape", shape)


def _write_actions(main: GraphWriter, sample: str, spec: PolicySpec) -> None:
    chunk = spec.chunk
    own = predicted = main.op("Slice", sample, *(main.constant([n]) for n in (0, chunk.action_dim, 2)))
    if chunk.normalizer is not None:
        affine = chunk.normalizer.at(slice(spec.sample[0]))
        predicted = main.op("Sub", predicted, main.constant(affine.offset, np.float32))
        predicted = main.op("Div", predicted, main.constant(affine.scale, np.float32))
    if chunk.relative is not None:
        predicted = write_absolute(main, predicted, _reference(main, chunk.relative, spec), chunk.relative)
    for one in chunk.switches:
        low, high, least = (main.constant([n], np.float32) for n in (one.below, one.above, one.threshold))
        value = main.op("Where", main.op("GreaterOrEqual", own, least), high, low)
        at = main.constant(np.arange(chunk.action_dim) == one.channel, np.bool_)
        predicted = main.op("Where", at, value, predicted)
    main.rename(predicted, "action_pred")
    main.rename(main.op("Slice", predicted, *(main.constant([n]) for n in (chunk.start, chunk.stop, 1))), "action")


def _reference(main: GraphWriter, relative: Relative, spec: PolicySpec) -> str:
    """``ChunkSpec.reference`` in ONNX: ``[B, 1, Da]``."""
    entries = spec.observations[relative.key].shape[-1]
    frames = main.op("Reshape", relative.key, main.constant([0, -1, entries]))
    newest = main.op("Gather", frames, main.constant([-1]), axis=1)
    padded = main.op("Pad", newest, main.constant([0, 0, 0, 0, 0, 1]))
    return main.op("Gather", padded, main.constant(relative.places(entries)), axis=2)


def _write_cache(main: GraphWriter, plans: ExecutedPlans, stored: str, new_rows: str, new_cells: str) -> None:
    """The next call's rollout cache: rows that were ``stored`` and not computed anew, then the new ones."""
    anew = main.op("Equal", plans.executed, main.constant(Source.COMPUTE.value, np.int8))
    known = main.op("And", main.op("GreaterOrEqual", "rollout_index", main.constant(0)), main.op("Not", anew))
    old = main.op("And", known, "rollout_keep")
    flat = main.constant([-1])
    old_cells = main.op("Reshape", main.op("NonZero", main.op("Reshape", old, flat)), flat)
    old_rows = main.op("Gather", stored, main.op("Gather", main.op("Reshape", "rollout_index", flat), old_cells))
    rows = main.op("Concat", old_rows, new_rows, axis=0)
    row = main.op("Shape", "rollout_rows", start=1)
    shape = main.op("Concat", main.op("Shape", rows, start=0, end=1), row, axis=0)
    main.rename(main.op("Reshape", rows, shape, allowzero=1), "rollout_rows_next")
    cells = main.op("Concat", old_cells, new_cells, axis=0)
    numbers = main.op("Range", main.constant(0), main.op("Size", cells), main.constant(1))
    shape = main.op("Shape", "rollout_index")
    size = main.op("ReduceProd", shape, keepdims=1)
    nothing = main.op("Expand", main.constant([-1]), size)
    merged = main.op("ScatterElements", nothing, cells, numbers, axis=0)
    main.rename(main.op("Reshape", merged, shape), "rollout_index_next")


Values = list[ValueInfoProto]


def write_interface(main: GraphWriter, program: Program, weights: Arrays) -> tuple[Values, Values]:
    """All inputs, those that may be left out with what they are then; and all outputs."""
    spec, pieces = program.spec, program.pieces
    observations = [tensor(key, each.dtype, ["B", *each.shape]) for key, each in spec.observations.items()]
    inputs, outputs = _of_every_policy(program)
    if pieces.pruner is not None:
        inputs += _of_pruner(main, pieces.pruner, weights)
    own = correction.no_correction(spec.sampler.steps, spec.sample).inputs()
    own[PLAIN] = np.zeros((spec.sampler.steps, len(program.blocks)), np.int8)
    inputs += [main.default(name, array) for name, array in own.items()]
    if numbers := condition_numbers(program):
        inputs += _of_condition(main, spec, numbers)
    if correction.may_jump(spec.sample):
        inputs += _of_jumps(main, spec, numbers)
    if clash := sorted(set(spec.observations) & {value.name for value in (*inputs, *outputs)}):
        what = f"the observations {clash} have names of the single file's own inputs or outputs"
        raise LoweringError(f"{what}. Rename them, or convert without the single file.")
    return [*observations, *inputs], outputs


def condition_numbers(program: Program) -> int:
    """N: how many numbers of one stream's condition a correction may read; 0 where there are too many."""
    types = program.pieces.conditions
    return correction.numbers_of(types[name].at(1) for name in program.pieces.features)


def _of_every_policy(program: Program) -> tuple[Values, Values]:
    spec, count = program.spec, len(program.blocks)
    (horizon, channels), chunk, steps = spec.sample, spec.chunk, spec.sampler.steps
    row = program.blocks[0].type.at(1)
    inputs = [tensor("initial_noise", np.float32, ["B", horizon, channels])]
    if spec.sampler.stochastic:
        inputs.append(tensor("step_noise", np.float32, [steps, "B", horizon, channels]))
    inputs += [
        tensor("plan", np.int8, ["P", steps, count]),
        tensor("rollout_rows", np.float32, ["R", *row]),
        tensor("rollout_index", np.int64, ["B", steps, count]),
        tensor("rollout_keep", np.bool_, [steps, count]),
    ]
    outputs = [
        tensor("action", np.float32, ["B", chunk.executes, chunk.action_dim]),
        tensor("action_pred", np.float32, ["B", horizon, chunk.action_dim]),
        tensor("executed_plan", np.int8, ["B", steps, count]),
        tensor("legalised", np.int64, ["B"]),
        tensor("outside", np.float32, ["B"]),
        tensor("rollout_rows_next", np.float32, ["R_next", *row]),
        tensor("rollout_index_next", np.int64, ["B", steps, count]),
    ]
    return inputs, outputs


def _of_pruner(main: GraphWriter, head: Graph, weights: Arrays) -> Values:
    """Whether the pruner makes the plan, and its weights: by default it does not, and they are those of the program."""
    constants = {name: np.asarray(weights[name], type_.dtype) for name, type_ in head.constants.items()}
    return [main.default(name, value) for name, value in {USE_PRUNER: np.array(False), **constants}.items()]


def _of_condition(main: GraphWriter, spec: PolicySpec, numbers: int) -> Values:
    """Those of a correction that reads N numbers of the condition; they read one that adds nothing by default."""
    (horizon, dimensions), steps = spec.sample, spec.sampler.steps
    shapes: dict[str, list[int | str]] = {ENVELOPE: [numbers, "E"], CENTER: ["E"]}
    shapes |= {correction.READING: [numbers, "F"], correction.OBSERVED: ["F", steps, dimensions, horizon]}
    zeros = {name: [1 if isinstance(n, str) else n for n in shape] for name, shape in shapes.items()}
    return [main.default(name, np.zeros(zeros[name], np.float32), shape) for name, shape in shapes.items()]


def _of_jumps(main: GraphWriter, spec: PolicySpec, numbers: int) -> Values:
    """Those of jumps that read N numbers of the condition; by default there are none."""
    steps, chunk = spec.sampler.steps, math.prod(spec.sample)
    layers = {
        correction.INNER: (numbers + correction.HISTORY * chunk + 1, correction.HIDDEN),
        correction.MIDDLE: (correction.HIDDEN + 1, correction.HIDDEN),
        correction.OUTER: (correction.HIDDEN + 1, chunk),
    }
    inputs = [main.default(correction.JUMPS, np.full(steps, -1, np.int64))]
    return inputs + [main.default(n, np.zeros((1, *shape), np.float32), ["J", *shape]) for n, shape in layers.items()]
