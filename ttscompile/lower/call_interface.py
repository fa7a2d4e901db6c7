"""Inputs and outputs of the model of the whole call; ``single_file`` says what they mean."""

from __future__ import annotations

import math

import numpy as np
from onnx import ValueInfoProto

from ..core.correction import (
    ANCHORS,
    CORRECTION,
    CORRECTION_BIAS,
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
from ..core.envelope import CENTER, ENVELOPE, PLAIN
from ..core.spec import PolicySpec
from ..errors import LoweringError
from ..ir.graph import Graph
from ..ir.pieces import USE_PRUNER
from ..ir.program import Program
from .graph_writer import GraphWriter, Weights, tensor

Values = list[ValueInfoProto]


def write_interface(main: GraphWriter, program: Program, weights: Weights) -> tuple[Values, Values]:
    """All inputs, those that may be left out with what they are then; and all outputs."""
    spec, pieces = program.spec, program.pieces
    observations = [tensor(key, each.dtype, ["B", *each.shape]) for key, each in spec.observations.items()]
    inputs, outputs = _of_every_policy(program)
    if pieces.pruner is not None:
        inputs += _of_pruner(main, pieces.pruner, weights)
    given = no_correction(spec.sampler.steps, spec.sample)
    for name, array in ((ANCHORS, given.anchors), (CORRECTION, given.weights), (CORRECTION_BIAS, given.bias)):
        inputs.append(tensor(name, array.dtype, array.shape))
        main.default(name, array)
    cells = spec.sampler.steps, len(program.blocks)
    main.default(PLAIN, np.zeros(cells, np.int8))
    inputs.append(tensor(PLAIN, np.int8, cells))
    if numbers := condition_numbers(program):
        inputs += _of_condition(main, spec, numbers)
    if may_jump(spec.sample):
        inputs += _of_jumps(main, spec, numbers)
    if clash := sorted(set(spec.observations) & {value.name for value in (*inputs, *outputs)}):
        what = f"the observations {clash} have names of the single file's own inputs or outputs"
        raise LoweringError(f"{what}. Rename them, or convert without the single file.")
    return [*observations, *inputs], outputs


def condition_numbers(program: Program) -> int:
    """N: how many numbers of one stream's condition a correction may read; 0 where there are too many."""
    types = program.pieces.condition.types()
    return numbers_of(types[name].at(1) for name in program.pieces.features)


def _of_every_policy(program: Program) -> tuple[Values, Values]:
    """What every policy has, beside its observations."""
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
        tensor("action", np.float32, ["B", chunk.stop - chunk.start, chunk.action_dim]),
        tensor("action_pred", np.float32, ["B", horizon, chunk.action_dim]),
        tensor("executed_plan", np.int8, ["B", steps, count]),
        tensor("legalised", np.int64, ["B"]),
        tensor("outside", np.float32, ["B"]),
        tensor("rollout_rows_next", np.float32, ["R_next", *row]),
        tensor("rollout_index_next", np.int64, ["B", steps, count]),
    ]
    return inputs, outputs


def _of_pruner(main: GraphWriter, head: Graph, weights: Weights) -> Values:
    """Whether the pruner makes the plan, and its weights: by default it does not, and they are those of the program."""
    main.default(USE_PRUNER, np.array(False))
    for name, type_ in head.constants.items():
        main.default(name, np.asarray(weights[name], type_.dtype))
    constants = [tensor(name, type_.dtype, type_.at(1)) for name, type_ in head.constants.items()]
    return [tensor(USE_PRUNER, np.bool_, []), *constants]


def _of_condition(main: GraphWriter, spec: PolicySpec, numbers: int) -> Values:
    """Those of a correction that reads N numbers of the condition; they read one that adds nothing by default."""
    (horizon, dimensions), steps = spec.sample, spec.sampler.steps
    main.default(ENVELOPE, np.zeros((numbers, 1), np.float32))
    main.default(CENTER, np.zeros(1, np.float32))
    main.default(READING, np.zeros((numbers, 1), np.float32))
    main.default(OBSERVED, np.zeros((1, steps, dimensions, horizon), np.float32))
    return [
        tensor(ENVELOPE, np.float32, [numbers, "E"]),
        tensor(CENTER, np.float32, ["E"]),
        tensor(READING, np.float32, [numbers, "F"]),
        tensor(OBSERVED, np.float32, ["F", steps, dimensions, horizon]),
    ]


def _of_jumps(main: GraphWriter, spec: PolicySpec, numbers: int) -> Values:
    """Those of jumps that read N numbers of the condition; by default there are none."""
    steps, chunk = spec.sampler.steps, math.prod(spec.sample)
    main.default(JUMPS, np.full(steps, -1, np.int64))
    inputs = [tensor(JUMPS, np.int64, [steps])]
    layers = {INNER: (numbers + HISTORY * chunk + 1, HIDDEN), MIDDLE: (HIDDEN + 1, HIDDEN), OUTER: (HIDDEN + 1, chunk)}
    for name, shape in layers.items():
        main.default(name, np.zeros((1, *shape), np.float32))
        inputs.append(tensor(name, np.float32, ["J", *shape]))
    return inputs
