"""The plans of all streams of a call in ONNX: given, or made by the pruner; then repaired, and each one counted once.

It is ``runtimes.settle`` and ``core.lattice.legalize`` written anew: the file runs without the package.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from onnx import GraphProto, TensorProto

from ..core.envelope import PLAIN
from ..core.lattice import Source
from .graph_writer import GraphWriter, tensor
from .plan import INT64

BOOL, FLOAT, INT8 = TensorProto.BOOL, TensorProto.FLOAT, TensorProto.INT8


@dataclass(frozen=True)
class ExecutedPlans:
    """Names of values; B streams, K steps, N blocks, G different plans.

    Attributes:
        executed: int8 [B, K, N], legal.
        legalised: int64 [B]; cells of each stream that are not as they were given, or as the pruner wanted them.
        different: int8 [G, K, N]; those of ``executed``, each once.
        which: int64 [B]; number of each stream's.
        far: int8 [G]; 1 of those whose streams have no correction. Streams of one plan that differ in this are apart.
        broken: float32 [B, 1, 1] or [1, 1, 1]; NaN for a stream whose pruner gave no numbers, and 0 otherwise.
    """

    executed: str
    legalised: str
    different: str
    which: str
    far: str
    broken: str


def write_executed_plans(
    w: GraphWriter,
    plan: str,
    index: str,
    streams: str,
    lattice: tuple[int, int],
    pruner: tuple[str, Callable[[GraphWriter], str]] | None,
    far: str,
) -> ExecutedPlans:
    """Write the nodes.

    Args:
        plan: int8 [1, K, N] or [B, K, N].
        index: int64 [B, K, N]; negative where the rollout cache has no residual of the cell.
        streams: B, int64 [1].
        lattice: K and N.
        pruner: bool [], whether it makes the plans, and what writes its logits [B, K, N, 4]; None without a pruner.
        far: bool [B]; streams that execute the input ``PLAIN`` instead.
    """
    cells = w.constant(lattice)
    shape = w.op("Concat", streams, cells, axis=0)
    if pruner is None:
        wanted, broken = w.op("Expand", plan, shape), w.constant(np.zeros((1, 1, 1)), np.float32)
    else:
        used, logits = pruner
        head, given = w.inner(), w.inner()
        branches = _of_pruner(head, logits(head)), _as_given(given, plan, shape)
        wanted, broken = w.ops("If", [used], 2, then_branch=branches[0], else_branch=branches[1])

    wanted = w.op("Where", w.op("Reshape", far, w.constant([-1, 1, 1])), PLAIN, wanted)
    after_first = np.ones((lattice[0], 1), np.int64)
    after_first[0] = Source.COMPUTE.value
    source = w.op("Mul", w.op("Cast", wanted, to=INT64), w.constant(after_first))
    unread = w.op("Less", index, w.constant(0))
    missing = w.op("And", w.op("Equal", source, w.constant(Source.ROLLOUT.value)), unread)
    executed = w.op("Cast", w.op("Where", missing, w.constant(Source.TIMESTEP.value), source), to=INT8)
    changed = w.op("Cast", w.op("Not", w.op("Equal", executed, wanted)), to=INT64)
    flat = w.op("Reshape", executed, w.constant([-1, lattice[0] * lattice[1]]))
    flat = w.op("Concat", flat, w.op("Reshape", w.op("Cast", far, to=INT8), w.constant([-1, 1])), axis=1)
    both, _, which = w.ops("Unique", [flat], 3, axis=0, sorted=0)
    once, flag = (w.op("Slice", both, *(w.constant([n]) for n in (*ends, 1))) for ends in ((0, -1), (-1, 2**31 - 1)))
    return ExecutedPlans(
        executed=executed,
        legalised=w.op("ReduceSum", changed, w.constant([1, 2]), keepdims=0),
        different=w.op("Reshape", once, w.constant([-1, *lattice])),
        which=which,
        far=w.op("Reshape", flag, w.constant([-1])),
        broken=broken,
    )


def _of_pruner(w: GraphWriter, logits: str) -> GraphProto:
    """The branch in which the largest logit of each cell says its source."""
    plan = w.op("Cast", w.op("ArgMax", logits, axis=3, keepdims=0), to=INT8)
    no_number = w.op("Cast", w.op("IsNaN", logits), to=FLOAT)
    some = w.op("ReduceMax", no_number, w.constant([1, 2, 3]), keepdims=0)
    broken = w.op("Where", w.op("Cast", some, to=BOOL), w.constant(np.nan, np.float32), w.constant(0, np.float32))
    shaped = w.op("Reshape", broken, w.constant([-1, 1, 1]))
    return w.graph("pruner", [tensor(plan, np.int8), tensor(shaped, np.float32)])


def _as_given(w: GraphWriter, plan: str, shape: str) -> GraphProto:
    """The branch that executes the plan of the caller."""
    same, fine = w.op("Expand", plan, shape), w.constant(np.zeros((1, 1, 1)), np.float32)
    return w.graph("given_plan", [tensor(same, np.int8), tensor(w.op("Identity", fine), np.float32)])
