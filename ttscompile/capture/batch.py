"""The batch as a symbol, found among the numbers of a graph, or of two that were captured with different batch sizes.

torch.export can reason about a symbolic batch, and gives up where it cannot prove something that is true:
``prediction.chunk(2, 0)`` of a doubled batch, say. With numbers there is nothing to prove. A size that is ``5 * c`` in
one graph and ``7 * c`` in the other is ``c * B``; one that is equal in both is a number; anything else is refused. One
graph is enough where every ``107 * c`` is ``c * B``, which the caller checks.
"""

from ..errors import CaptureError
from ..ir.graph import Argument, Batch, Graph, Node, Size, TensorType

BATCHES = (5, 7)
"""Batch sizes to capture with: primes that are no divisors of what networks are made of."""

RARE = 107
"""Batch size to capture with at first: few numbers of networks are a multiple of it."""


def unify_batch(left: Graph, right: Graph, batches: tuple[int, int] = BATCHES) -> Graph:
    """One graph for every batch size.

    Args:
        left: captured with a batch of ``batches[0]``.
        right: the same module captured with a batch of ``batches[1]``; ``left`` itself for ``(RARE, RARE)``.

    Raises:
        CaptureError: they differ in more than the batch size; names the first node that does.
    """
    inputs = {name: _type(name, type_, right.inputs[name], batches) for name, type_ in left.inputs.items()}
    if left.constants != right.constants:
        raise CaptureError(f"the module makes constants that depend on the batch size.{REMEDY}")
    if len(left.nodes) != len(right.nodes) or left.outputs != right.outputs:
        counts = f"{len(left.nodes)} operations for a batch of {batches[0]} and {len(right.nodes)} for {batches[1]}"
        raise CaptureError(f"the module takes {counts}.{REMEDY}")
    nodes = tuple(_node(a, b, batches) for a, b in zip(left.nodes, right.nodes, strict=True))
    return Graph(inputs, left.constants, nodes, left.outputs)


REMEDY = " Every stream of a batch must be computed alike, whatever their number: no loop or branch on the batch size."


def _node(left: Node, right: Node, batches: tuple[int, int]) -> Node:
    where = f"%{left.name} ({left.source})"
    if (left.name, left.op) != (right.name, right.op):
        raise CaptureError(f"{where} is {left.op} for a batch of {batches[0]} and {right.op} for another.{REMEDY}")
    if len(left.types) != len(right.types):
        raise CaptureError(f"{where} gives {len(left.types)} values or {len(right.types)}, by the batch size.{REMEDY}")
    return Node(
        left.name,
        left.op,
        _arguments(where, left.args, right.args, batches),
        tuple(
            (key, _argument(where, a, b, batches)) for (key, a), (_, b) in zip(left.kwargs, right.kwargs, strict=True)
        ),
        tuple(_type(where, a, b, batches) for a, b in zip(left.types, right.types, strict=True)),
        left.source,
    )


def _arguments(
    where: str, left: tuple[Argument, ...], right: tuple[Argument, ...], batches: tuple[int, int]
) -> tuple[Argument, ...]:
    if len(left) != len(right):
        raise CaptureError(f"{where} has {len(left)} arguments or {len(right)}, by the batch size.{REMEDY}")
    return tuple(_argument(where, a, b, batches) for a, b in zip(left, right, strict=True))


def _argument(where: str, left: Argument, right: Argument, batches: tuple[int, int]) -> Argument:
    if isinstance(left, tuple) and isinstance(right, tuple):
        return _arguments(where, left, right, batches)
    if type(left) is int and type(right) is int:
        return _size(where, left, right, batches)
    if left != right:
        raise CaptureError(f"{where} has the argument {left} or {right}, by the batch size.{REMEDY}")
    return left


def _type(where: str, left: TensorType, right: TensorType, batches: tuple[int, int]) -> TensorType:
    if len(left.shape) != len(right.shape) or left.dtype != right.dtype:
        raise CaptureError(f"{where} is {left} or {right}, by the batch size.{REMEDY}")
    sizes = (_size(where, a, b, batches) for a, b in zip(left.shape, right.shape, strict=True))
    return TensorType(tuple(sizes), left.dtype)


def _size(where: str, left: Size, right: Size, batches: tuple[int, int]) -> Size:
    assert isinstance(left, int)
    assert isinstance(right, int)
    multiple = left // batches[0]
    if multiple and (left, right) == (multiple * batches[0], multiple * batches[1]):  # negative: from the end
        return Batch(multiple)
    if left != right:
        raise CaptureError(
            f"a size at {where} is {left} for a batch of {batches[0]} and {right} for {batches[1]}, which is not a"
            " multiple of the batch size. Only the batch may vary; write the other sizes as numbers."
        )
    return left
