"""Values with several rows a stream: which rows of ``[m * B, ...]`` belong to which stream.

Guidance runs the network on a doubled batch; attention folds its heads into the batch. Caches, plans and tables are a
stream's own, so a value that crosses from one piece of the program to another needs an axis of size exactly B: it
crosses as ``[m, B, ...]`` or ``[B, m, ...]``, which is a reshape.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from ..errors import PassError
from .graph import Batch, Graph, Node, Ref, Size, TensorType

_RESHAPE = "aten.reshape.default"


class Order(enum.Enum):
    """Which factor of an axis ``m * B`` is the outer one."""

    COPIES = "copies"  # [m, B]: the whole batch, m times
    STREAMS = "streams"  # [B, m]: m rows of each stream


@dataclass(frozen=True)
class Rows:
    """How a value crosses.

    Attributes:
        name: of the value ``[.., m * B, ..]``.
        type: of that value.
        crossing: its name where it crosses.
        unfolded: its type there, with an axis of size B.
    """

    name: str
    type: TensorType
    crossing: str
    unfolded: TensorType

    def leave(self) -> Node:
        """The node that makes the crossing value."""
        return Node(self.crossing, _RESHAPE, (Ref(self.name), self.unfolded.shape), (), (self.unfolded,))

    def enter(self) -> Node:
        """The node that makes the value again, where it is read."""
        return Node(self.name, _RESHAPE, (Ref(self.crossing), self.type.shape), (), (self.type,))


def unfold(graph: Graph, names: Iterable[str]) -> dict[str, Rows]:
    """How those of ``names`` cross that have an axis ``m * B`` and none of size B; by name.

    Raises:
        PassError: it cannot be seen from the operations which rows belong to which stream.
    """
    types = graph.types()
    wanted = [n for n in names if types[n].batch_axis is None and _axis(types[n]) is not None]
    if not wanted:
        return {}
    orders = _orders(graph, types)
    return {name: _rows(name, types[name], orders.get(name)) for name in wanted}


def _axis(type_: TensorType) -> int | None:
    return next((i for i, size in enumerate(type_.shape) if isinstance(size, Batch)), None)


def _rows(name: str, type_: TensorType, order: Order | None) -> Rows:
    axis = _axis(type_)
    assert axis is not None
    if order is None:
        raise PassError(
            f"%{name} : {type_} has several rows a stream, and it cannot be seen which. Double the batch with"
            " torch.cat, repeat or repeat_interleave, and keep its order."
        )
    size = type_.shape[axis]
    assert isinstance(size, Batch)
    factors: tuple[Size, Size] = (size.multiple, Batch()) if order is Order.COPIES else (Batch(), size.multiple)
    shape = (*type_.shape[:axis], *factors, *type_.shape[axis + 1 :])
    return Rows(name, type_, f"{name}.rows", replace(type_, shape=shape))


def _orders(graph: Graph, types: Mapping[str, TensorType]) -> dict[str, Order]:
    """The order of every value with an axis ``m * B`` of which it is known."""
    known: dict[str, Order] = {}
    for node in graph.nodes:
        axis = _axis(node.type)
        if axis is None or node.type.batch_axis is not None:
            continue
        order = _made(node, axis, types)
        if order is None:
            inherited = {
                known.get(n) for n in node.refs() if types[n].batch_axis is None and _axis(types[n]) is not None
            }
            order = inherited.pop() if len(inherited) == 1 else None
        if order is not None:
            known[node.name] = order
    return known


def _made(node: Node, axis: int, types: Mapping[str, TensorType]) -> Order | None:
    """The order that an operation gives to an axis ``m * B`` which its arguments do not have."""
    streams = [types[n] for n in node.refs() if types[n].batch_axis is not None]
    if not streams:
        return None
    match node.op.split(".")[1]:
        case "cat":
            joined = node.args[1] if len(node.args) > 1 else 0
            return Order.COPIES if isinstance(joined, int) and joined % len(node.type.shape) == axis else None
        case "repeat" | "tile":
            return Order.COPIES
        case "repeat_interleave":
            return Order.STREAMS
        case "reshape" | "view" | "_unsafe_view" | "flatten":
            return _merged(streams[0].shape, node.type.shape, axis)
    return None


def _merged(before: tuple[Size, ...], after: tuple[Size, ...], axis: int) -> Order | None:
    """A reshape that merges an axis of size B with its neighbours."""
    inner = _numbers(after[axis + 1 :])
    position = before.index(Batch())
    behind, factor = _numbers(before[position + 1 :]), after[axis]
    assert isinstance(factor, Batch)
    if behind == inner:
        return Order.COPIES
    return Order.STREAMS if behind == inner * factor.multiple else None


def _numbers(sizes: tuple[Size, ...]) -> int:
    product = 1
    for size in sizes:
        product *= size if isinstance(size, int) else 0
    return product


def crossing_inputs(graph: Graph, rows: Mapping[str, Rows]) -> Graph:
    """The graph with the inputs that are in ``rows`` as they cross."""
    found = [rows[name] for name in graph.inputs if name in rows]
    inputs = {}
    for name, type_ in graph.inputs.items():
        if name in rows:
            inputs[rows[name].crossing] = rows[name].unfolded
        else:
            inputs[name] = type_
    return replace(graph, inputs=inputs, nodes=(*(one.enter() for one in found), *graph.nodes)) if found else graph


def crossing_outputs(graph: Graph, rows: Mapping[str, Rows]) -> Graph:
    """The graph with the outputs that are in ``rows`` as they cross; what it has already is not made again."""
    there = graph.types()
    nodes = [rows[n].leave() for n in dict.fromkeys(graph.outputs) if n in rows and rows[n].crossing not in there]
    outputs = tuple(rows[n].crossing if n in rows else n for n in graph.outputs)
    return replace(graph, nodes=(*graph.nodes, *nodes), outputs=outputs)
