"""Values with several rows a stream: which rows of ``[m * B, ...]`` belong to which stream.

Guidance runs the network on a doubled batch; attention folds its heads into the batch. Caches, plans and tables are a
stream's own, so a value that crosses from one piece of the program to another needs an axis of size exactly B: it
crosses as ``[m, B, ...]``, ``[B, m, ...]``, or ``[c, B, r, ...]`` where both happened, which is a reshape.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from ..errors import PassError
from .graph import Batch, Graph, Node, Size, TensorType, reshaped
from .operations import Movement, axes_along, joined_axis, operation


class _Layout(NamedTuple):
    """The factors of an axis ``copies * B * rows``, outermost first."""

    copies: int
    rows: int


@dataclass(frozen=True)
class Rows:
    """How a value ``[.., m * B, ..]`` crosses: its name there, and its type with an axis of size B."""

    name: str
    type: TensorType
    crossing: str
    unfolded: TensorType

    def leave(self) -> Node:
        """The node that makes the crossing value."""
        return reshaped(self.crossing, self.name, self.unfolded)

    def enter(self) -> Node:
        """The node that makes the value again, where it is read."""
        return reshaped(self.name, self.crossing, self.type)


def unfold(graph: Graph, names: Iterable[str]) -> dict[str, Rows]:
    """How those of ``names`` cross that have an axis ``m * B`` and none of size B; by name."""
    types = graph.types()
    wanted = [n for n in names if types[n].batch_axis is None and _axis(types[n]) is not None]
    if not wanted:
        return {}
    layouts = _layouts(graph, types)
    return {name: _rows(name, types[name], layouts.get(name)) for name in wanted}


def _axis(type_: TensorType) -> int | None:
    return next((i for i, size in enumerate(type_.shape) if isinstance(size, Batch)), None)


def _rows(name: str, type_: TensorType, layout: _Layout | None) -> Rows:
    axis = _axis(type_)
    assert axis is not None
    if layout is None:
        what = f"%{name} : {type_} has several rows a stream, and it cannot be seen which."
        raise PassError(f"{what} Double the batch with torch.cat, repeat or repeat_interleave, and keep its order.")
    factors: list[Size] = [n for n in (layout.copies, Batch(), layout.rows) if n != 1]
    return Rows(name, type_, f"{name}.rows", type_.with_axis(axis, *factors))


def _layouts(graph: Graph, types: Mapping[str, TensorType]) -> dict[str, _Layout]:
    """The layout of every value with an axis of streams of which it is known."""
    known = {name: _Layout(1, 1) for name, type_ in types.items() if type_.batch_axis is not None}
    alike: dict[str, _Layout] = {}  # all rows of one number, so that every layout fits
    for node in graph.nodes:
        axis = _axis(node.type)
        read = [name for name in node.refs() if _axis(types[name]) is not None and name not in alike]
        if axis is None or node.name in known or not all(name in known for name in read):
            continue
        if not read:
            size = node.type.shape[axis]
            if isinstance(size, Batch) and (operation(node.op).filled is not None or node.op == "aten.expand.default"):
                alike[node.name] = _Layout(size.multiple, 1)
            continue
        layout = _made(node, axis, [types[name] for name in read], [known[name] for name in read])
        if layout is not None:
            known[node.name] = layout
    return {**known, **alike}


def _made(node: Node, axis: int, read: Sequence[TensorType], layouts: Sequence[_Layout]) -> _Layout | None:
    """The layout that an operation gives to an axis ``m * B`` of its result; None if it cannot be seen."""
    size, (copies, rows) = node.type.shape[axis], layouts[0]
    assert isinstance(size, Batch)
    row, rank = operation(node.op), len(node.type.shape)
    kept = row.movement is None and rank == len(read[0].shape)  # a mean without its axis leaves the others in order
    if row.name in ("repeat", "tile"):
        copies = size.multiple // rows
    elif row.name == "repeat_interleave":
        rows = size.multiple // copies
    elif row.movement is Movement.RESHAPE:
        # What lies behind a stream in memory stays behind it.
        before, after = _axis(read[0]), _numbers(node.type.shape[axis + 1 :])
        assert before is not None
        rows, rest = divmod(rows * _numbers(read[0].shape[before + 1 :]), after or 1)
        if rest or not after or not rows:
            return None
        copies = size.multiple // rows
    elif row.name == "cat" and joined_axis(node) == axis and len({layout.rows for layout in layouts}) == 1:
        copies = sum(layout.copies for layout in layouts)
    elif len(set(layouts)) > 1 or (kept and axis in axes_along(node, rank)):
        return None  # rows of several kinds, or rows that change places
    return _Layout(copies, rows) if copies * rows == size.multiple else None


def _numbers(sizes: tuple[Size, ...]) -> int:
    """Product of sizes; 0 if the batch is among them."""
    return math.prod(size if isinstance(size, int) else 0 for size in sizes)


def crossing_inputs(graph: Graph, rows: Mapping[str, Rows]) -> Graph:
    """The graph with the inputs that are in ``rows`` as they cross."""
    found = [rows[name] for name in graph.inputs if name in rows]
    crossing = {one.name: (one.crossing, one.unfolded) for one in found}
    inputs = dict(crossing.get(name, (name, type_)) for name, type_ in graph.inputs.items())
    return replace(graph, inputs=inputs, nodes=(*(one.enter() for one in found), *graph.nodes)) if found else graph


def crossing_outputs(graph: Graph, rows: Mapping[str, Rows]) -> Graph:
    """The graph with the outputs that are in ``rows`` as they cross; what it has already is not made again."""
    there = graph.types()
    nodes = [rows[n].leave() for n in dict.fromkeys(graph.outputs) if n in rows and rows[n].crossing not in there]
    outputs = tuple(rows[n].crossing if n in rows else n for n in graph.outputs)
    return replace(graph, nodes=(*graph.nodes, *nodes), outputs=outputs)
