"""A plan to matrices that a loop can multiply with, in ONNX: what ``runtimes.instructions`` does in numpy.

Blocks that are reused between two computed ones make a *gap*; what a gap adds is a row of coefficients times residuals
that are there when the step begins (``from_table``, ``from_rollout``), plus FORWARD reads of residuals computed in the
same step (``from_step``). A step has one gap more than it has computed blocks. Rows are in order of execution.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from onnx import GraphProto, TensorProto

from ..core.envelope import PLAIN
from ..core.lattice import Source
from .graph_writer import GraphWriter, tensor

INT64 = TensorProto.INT64


@dataclass(frozen=True)
class LoweredPlan:
    """Names of values; K steps, N blocks, G gaps.

    Attributes:
        computed: bool [K, N].
        position: int64 [K, N + 1]; how many blocks of the step are computed before this one.
        computed_steps: int64 scalar; S, how many steps have a computed block.
        steps: int64 [S]; which.
        idle: int64 [S]; how many steps without one follow.
        first_row: int64 [K]; first gap of each step.
        stop_row: int64 [K]; one past its last.
        from_table: float32 [G, N]; how often the gap adds each block's last computed residual.
        from_step: float32 [G, N]; the same of blocks computed earlier in the step.
        from_rollout: float32 [G, N]; the same of the step's entries of the rollout cache.
        in_step: bool [K, N + 1]; whether the gap before a block, or the step's last, reads ``from_step``.
        rollout: bool [K, N].
        any_rollout: bool [K].
        same: bool [K]; the step is idle, and adds what the idle step before added.
        any_of_group: bool [K, groups of blocks]; any block of it is computed.
    """

    computed: str
    position: str
    computed_steps: str
    steps: str
    idle: str
    first_row: str
    stop_row: str
    from_table: str
    from_step: str
    from_rollout: str
    in_step: str
    rollout: str
    any_rollout: str
    same: str
    any_of_group: str


# PLR0915: a node a line
def lower_plan(w: GraphWriter, plan: str, groups: Sequence[int], steps: int, together: int) -> LoweredPlan:  # noqa: PLR0915
    """Write the nodes that lower a plan."""
    count = len(groups)
    # Which cells are what. Booleans and int64 throughout: onnxruntime has kernels for all of these.
    source = w.op("Cast", plan, to=INT64)
    computed = w.op("Equal", source, w.constant(0))
    ones = w.op("Cast", computed, to=INT64)
    per_step = w.op("ReduceSum", ones, w.constant([1]), keepdims=0)
    busy = w.op("Greater", per_step, w.constant(0))
    rollout = w.op("Equal", source, w.constant(3))
    any_rollout = w.op("ReduceMax", rollout, w.constant([1]), keepdims=0)

    # Gaps.
    position = w.op("CumSum", w.op("Pad", ones, w.constant([0, 0, 0, 1])), w.constant(1), exclusive=1)
    ends = w.op("CumSum", w.op("Add", per_step, w.constant(1)), w.constant(0))
    starts = w.op("Sub", w.op("Sub", ends, per_step), w.constant(1))
    gap = w.op("Add", w.op("Unsqueeze", starts, w.constant([1])), position)  # [K, N + 1]
    own_gap = w.op("Slice", gap, w.constant([0]), w.constant([count]), w.constant([1]))

    # FORWARD reads the newest residual of its group: the last cell before it that is computed, group by group in the
    # order of execution. Step 0 is dense, so that none of an earlier group is read.
    cells = np.arange(steps * count).reshape(steps, count)
    order = np.concatenate([cells[:, np.array(groups) == group].reshape(-1) for group in dict.fromkeys(groups)])
    flags = w.op("Gather", w.op("Reshape", computed, w.constant([-1])), w.constant(order))
    seen = w.op("CumSum", w.op("Cast", flags, to=INT64), w.constant(0), exclusive=1)
    last = w.op("Max", w.op("Sub", seen, w.constant(1)), w.constant(0))
    known = w.op("Gather", w.op("Compress", w.constant(order), flags), last)
    newest = w.op("Gather", known, w.constant(np.argsort(order).reshape(steps, count)))
    here = w.op("Equal", w.op("Div", newest, w.constant(count)), w.constant(np.arange(steps)[:, None]))
    block = w.op("Mod", newest, w.constant(count))
    forward = w.op("Where", here, w.op("Add", block, w.constant(count)), block)
    itself = w.constant(np.broadcast_to(np.arange(count), (steps, count)))
    column = w.op("Where", w.op("Equal", source, w.constant(1)), forward, itself)
    column = w.op("Where", rollout, w.op("Add", itself, w.constant(2 * count)), column)

    # Coefficients: one for each reused cell, at its gap and what it reads.
    reused = w.op("Not", computed)
    flat = w.constant([-1])
    chosen = w.op("Reshape", reused, flat)
    rows = w.op("Compress", w.op("Reshape", own_gap, flat), chosen)
    columns = w.op("Compress", w.op("Reshape", column, flat), chosen)
    places = w.op("Concat", *(w.op("Unsqueeze", n, w.constant([1])) for n in (rows, columns)), axis=1)
    gaps = w.op("Slice", ends, w.constant([-1]), w.constant([steps]))
    nothing = w.op("ConstantOfShape", w.op("Concat", gaps, w.constant([3 * count]), axis=0))
    units = w.op("Expand", w.constant(1, np.float32), w.op("Shape", rows))
    matrix = w.op("ScatterND", nothing, places, units, reduction="add")
    parts = w.ops("Split", [matrix], 3, axis=1, num_outputs=3)
    in_step = w.op("Greater", w.op("ReduceMax", parts[1], w.constant([1]), keepdims=0), w.constant(0, np.float32))

    # Steps in a row that add the same.
    idle = w.op("Not", busy)
    plain = w.op("And", idle, w.op("Not", any_rollout))
    row = w.op("Gather", parts[0], starts)
    change = w.op("ReduceMax", w.op("Abs", w.op("Sub", row, _shifted(w, row, steps))), w.constant([1]), keepdims=0)
    same = w.op("And", w.op("And", plain, _shifted(w, plain, steps)), w.op("Equal", change, w.constant(0, np.float32)))
    which = w.op("Reshape", w.op("NonZero", busy), flat)
    number = w.op("Shape", which)
    following = w.op("Concat", w.op("Slice", which, w.constant([1]), number), w.constant([steps]), axis=0)
    groups_of = -(-count // together)
    padded = w.op("Pad", ones, w.constant([0, 0, 0, groups_of * together - count]))
    folded = w.op("Reshape", padded, w.constant([steps, groups_of, together]))
    return LoweredPlan(
        computed=computed,
        position=position,
        computed_steps=w.op("Reshape", number, w.constant(np.zeros(0))),
        steps=which,
        idle=w.op("Sub", w.op("Sub", following, which), w.constant(1)),
        first_row=starts,
        stop_row=ends,
        from_table=parts[0],
        from_step=parts[1],
        from_rollout=parts[2],
        in_step=w.op("Gather", in_step, gap),
        rollout=rollout,
        any_rollout=any_rollout,
        same=same,
        any_of_group=w.op("Greater", w.op("ReduceMax", folded, w.constant([2]), keepdims=0), w.constant(0)),
    )


def _shifted(w: GraphWriter, rows: str, steps: int) -> str:
    """Each row's predecessor; the first row's is itself."""
    return w.op("Gather", rows, w.constant(np.maximum(np.arange(steps) - 1, 0)))


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
    """Write the nodes that settle the plans of all streams: given, or made by the pruner; repaired, each counted once.

    It is ``runtimes.settle`` and ``core.lattice.legalize`` written anew: the file runs without the package.

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

    plain, own = (w.op("Cast", one, to=INT64) for one in (PLAIN, wanted))  # Where has int8 from onnxruntime 1.31 on
    wanted = w.op("Cast", w.op("Where", w.op("Reshape", far, w.constant([-1, 1, 1])), plain, own), to=INT8)
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
    plan = w.op("Cast", w.op("ArgMax", logits, axis=3, keepdims=0), to=INT8)
    no_number = w.op("Cast", w.op("IsNaN", logits), to=FLOAT)
    some = w.op("ReduceMax", no_number, w.constant([1, 2, 3]), keepdims=0)
    broken = w.op("Where", w.op("Cast", some, to=BOOL), w.constant(np.nan, np.float32), w.constant(0, np.float32))
    shaped = w.op("Reshape", broken, w.constant([-1, 1, 1]))
    return w.graph("pruner", [tensor(plan, np.int8), tensor(shaped, np.float32)])


def _as_given(w: GraphWriter, plan: str, shape: str) -> GraphProto:
    same, fine = w.op("Expand", plan, shape), w.constant(np.zeros((1, 1, 1)), np.float32)
    return w.graph("given_plan", [tensor(same, np.int8), tensor(w.op("Identity", fine), np.float32)])
