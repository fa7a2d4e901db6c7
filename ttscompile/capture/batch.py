"""The batch as a symbol, found by comparing two graphs of one module that were captured with different batch sizes.

torch.export can reason about a symbolic batch, and gives up where it cannot prove something that is true:
``prediction.chunk(2, 0)`` of a doubled batch, say. With numbers there is nothing to prove, and both captures together
take no longer. A size that is ``5 * c`` in one graph and ``7 * c`` in the other is ``c * B``; one that is equal in both
is a number; anything else is refused.
"""

from ..errors import CaptureError
from ..ir.graph import Argument, Batch, Graph, Node, Size, TensorType

BATCHES = (5, 7)
"""Batch sizes to capture with: primes that are no divisors of what networks are made of."""


def unify_batch(left: Graph, right: Graph) -> Graph:
    """One graph for every batch size.

    Args:
        left: captured with a batch of ``BATCHES[0]``.
        right: the same module captured with a batch of ``BATCHES[1]``.

    Raises:
        CaptureError: they differ in more than the batch size; names the first node that does.
    """
    inputs = {name: _type(name, type_, right.inputs[name]) for name, type_ in left.inputs.items()}
    if left.constants != right.constants:
        raise CaptureError(f"the module makes constants that depend on the batch size.{REMEDY}")
    if len(left.nodes) != len(right.nodes) or left.outputs != right.outputs:
        counts = f"{len(left.nodes)} operations for a batch of {BATCHES[0]} and {len(right.nodes)} for {BATCHES[1]}"
        raise CaptureError(f"the module takes {counts}.{REMEDY}")
    nodes = tuple(_node(a, b) for a, b in zip(left.nodes, right.nodes, strict=True))
    return Graph(inputs, left.constants, nodes, left.outputs)


REMEDY = " Every stream of a batch must be computed alike, whatever their number: no loop or branch on the batch size."


def _node(left: Node, right: Node) -> Node:
    where = f"%{left.name} ({left.source})"
    if (left.name, left.op) != (right.name, right.op):
        raise CaptureError(f"{where} is {left.op} for a batch of {BATCHES[0]} and {right.op} for another.{REMEDY}")
    if len(left.types) != len(right.types):
        raise CaptureError(f"{where} gives {len(left.types)} values or {len(right.types)}, by the batch size.{REMEDY}")
    return Node(
        left.name,
        left.op,
        _arguments(where, left.args, right.args),
        tuple((key, _argument(where, a, b)) for (key, a), (_, b) in zip(left.kwargs, right.kwargs, strict=True)),
        tuple(_type(where, a, b) for a, b in zip(left.types, right.types, strict=True)),
        left.source,
    )


def _arguments(where: str, left: tuple[Argument, ...], right: tuple[Argument, ...]) -> tuple[Argument, ...]:
    if len(left) != len(right):
        raise CaptureError(f"{where} has {len(left)} arguments or {len(right)}, by the batch size.{REMEDY}")
    return tuple(_argument(where, a, b) for a, b in zip(left, right, strict=True))


def _argument(where: str, left: Argument, right: Argument) -> Argument:
    if isinstance(left, tuple) and isinstance(right, tuple):
        return _arguments(where, left, right)
    if type(left) is int and type(right) is int:
        return _size(where, left, right)
    if left != right:
        raise CaptureError(f"{where} has the argument {left} or {right}, by the batch size.{REMEDY}")
    return left


def _type(where: str, left: TensorType, right: TensorType) -> TensorType:
    if len(left.shape) != len(right.shape) or left.dtype != right.dtype:
        raise CaptureError(f"{where} is {left} or {right}, by the batch size.{REMEDY}")
    return TensorType(tuple(_size(where, a, b) for a, b in zip(left.shape, right.shape, strict=True)), left.dtype)


def _size(where: str, left: Size, right: Size) -> Size:
    assert isinstance(left, int)
    assert isinstance(right, int)
    if left == right:
        return left
    multiple = left // BATCHES[0]
    if not multiple or (left, right) != (multiple * BATCHES[0], multiple * BATCHES[1]):  # negative: from the end
        raise CaptureError(
            f"a size at {where} is {left} for a batch of {BATCHES[0]} and {right} for {BATCHES[1]}, which is not a"
            " multiple of the batch size. Only the batch may vary; write the other sizes as numbers."
        )
    return Batch(multiple)
