"""The graph of a denoiser, and of every piece it is cut into: ATen operations on named values.

A ``Graph`` is immutable and knows no torch. The batch size is the only symbolic size: ``Batch(c)`` stands for
``c * B``, so that every piece runs on any number of streams. Weights are named constants, kept beside the graph.

    Graph(inputs=(h,), constants=(w, b), outputs=(linear,))
      %linear : float32[B, 16, 64] = aten.linear.default(%h, %w, %b)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias, Union


@dataclass(frozen=True)
class Batch:
    """The symbolic size ``multiple * B``, B being the number of streams in a batch."""

    multiple: int = 1

    def __str__(self) -> str:
        return "B" if self.multiple == 1 else f"{self.multiple}*B"


Size: TypeAlias = Union[int, Batch]


@dataclass(frozen=True)
class Ref:
    """A use of the value ``name``: an input, a constant or the result of a node."""

    name: str


@dataclass(frozen=True)
class Enum:
    """A torch enumeration as an argument: ``Enum("dtype", "float32")``."""

    kind: str
    name: str


Argument: TypeAlias = Union[None, bool, int, float, str, Batch, Ref, Enum, "tuple[Argument, ...]"]


@dataclass(frozen=True)
class TensorType:
    """Shape and dtype (numpy name) of a value."""

    shape: tuple[Size, ...]
    dtype: str

    @property
    def batch_axis(self) -> int | None:
        """The axis of size exactly ``B``; None if there is none."""
        return self.shape.index(Batch()) if Batch() in self.shape else None

    def at(self, streams: int) -> tuple[int, ...]:
        """The concrete shape for this number of streams."""
        return tuple(n.multiple * streams if isinstance(n, Batch) else n for n in self.shape)

    def resized(self, size: Callable[[Batch], Size]) -> TensorType:
        """With others in the place of the symbolic sizes."""
        return replace(self, shape=tuple(size(n) if isinstance(n, Batch) else n for n in self.shape))

    def with_axis(self, axis: int, *sizes: Size) -> TensorType:
        """With one axis, or several, of these sizes in the place of the one that is there."""
        return replace(self, shape=(*self.shape[:axis], *sizes, *self.shape[axis + 1 :]))

    def __str__(self) -> str:
        return f"{self.dtype}[{', '.join(map(str, self.shape))}]"


GETITEM = "getitem"
"""The one operation that is not ATen's: ``getitem(node, i)`` takes the i-th result of a node with several."""


@dataclass(frozen=True)
class Node:
    """One operation.

    Attributes:
        name: of its result, unique in the graph.
        op: full ATen name, aten.linear.default, or getitem.
        args: positional arguments; values are Ref, lists are tuples.
        kwargs: keyword arguments, sorted by name.
        types: one type a result; a node with one result has one.
        source: where it comes from in the user's code (file:line), for messages; never written to an artifact.
    """

    name: str
    op: str
    args: tuple[Argument, ...]
    kwargs: tuple[tuple[str, Argument], ...]
    types: tuple[TensorType, ...]
    source: str = ""

    @property
    def type(self) -> TensorType:
        """Type of the only result."""
        return self.types[0]

    @property
    def place(self) -> str:
        """Its source for a message, also where that is not known."""
        return self.source or "source unknown"

    def argument(self, position: int, missing: Argument = None) -> Argument:
        """The positional argument; ``missing`` where there are fewer."""
        return self.args[position] if position < len(self.args) else missing

    def refs(self) -> Iterator[str]:
        """Names of the values that it reads, with repetitions, in order."""
        return (leaf.name for leaf in self.leaves() if isinstance(leaf, Ref))

    def leaves(self) -> Iterator[Argument]:
        """Its arguments and, in place of lists, what is in them; positional ones first."""
        return _leaves((*self.args, *(value for _, value in self.kwargs)))

    def mentions_batch(self) -> bool:
        """Whether the batch size is among its arguments."""
        return any(isinstance(leaf, Batch) for leaf in self.leaves())

    def renamed(self, rename: Callable[[str], str]) -> Node:
        """The same operation on other values; its own name is kept."""
        return self.mapped(lambda leaf: Ref(rename(leaf.name)) if isinstance(leaf, Ref) else leaf)

    def resized(self, size: Callable[[Batch], Size]) -> Node:
        """The same operation with others in the place of the symbolic sizes."""
        node = self.mapped(lambda leaf: size(leaf) if isinstance(leaf, Batch) else leaf)
        return replace(node, types=tuple(type_.resized(size) for type_ in self.types))

    def mapped(self, function: Callable[[Argument], Argument]) -> Node:
        """The same operation on what the function makes of each of its ``leaves``."""
        args = tuple(_map(a, function) for a in self.args)
        return replace(self, args=args, kwargs=tuple((k, _map(a, function)) for k, a in self.kwargs))

    def __str__(self) -> str:
        args = [_show(a) for a in self.args] + [f"{k}={_show(a)}" for k, a in self.kwargs]
        types = ", ".join(map(str, self.types))
        return f"%{self.name} : {types} = {self.op}({', '.join(args)})"


@dataclass(frozen=True)
class Graph:
    """A straight-line function.

    Attributes:
        inputs: name and type of each input, in order.
        constants: name and type of each weight; their values live in the program's weights.
        nodes: in topological order.
        outputs: names of values.
    """

    inputs: Mapping[str, TensorType]
    constants: Mapping[str, TensorType]
    nodes: tuple[Node, ...]
    outputs: tuple[str, ...]

    def types(self) -> dict[str, TensorType]:
        """Type of every value; of a node with several results the type of the first."""
        return {**self.inputs, **self.constants, **{n.name: n.type for n in self.nodes}}

    def producers(self) -> dict[str, Node]:
        """Node by the name of its result."""
        return {n.name: n for n in self.nodes}

    def users(self) -> dict[str, list[Node]]:
        """Nodes that read each value, in order; a value nobody reads has an empty list."""
        users: dict[str, list[Node]] = {name: [] for name in self.types()}
        for node in self.nodes:
            for name in dict.fromkeys(node.refs()):
                users[name].append(node)
        return users

    def renamed(self, names: Mapping[str, str]) -> Graph:
        """The same function with these values, by their names, called otherwise, wherever they are."""

        def called(name: str) -> str:
            return names.get(name, name)

        inputs, constants = ({called(n): t for n, t in types.items()} for types in (self.inputs, self.constants))
        nodes = tuple(replace(node.renamed(called), name=called(node.name)) for node in self.nodes)
        return Graph(inputs, constants, nodes, tuple(map(called, self.outputs)))

    def mapped(self, leaf: Callable[[Argument], Argument], kind: Callable[[TensorType], TensorType]) -> Graph:
        """The same values, with what ``leaf`` makes of the arguments of nodes, and ``kind`` of all types."""
        inputs, constants = ({n: kind(t) for n, t in types.items()} for types in (self.inputs, self.constants))
        nodes = (replace(node.mapped(leaf), types=tuple(map(kind, node.types))) for node in self.nodes)
        return Graph(inputs, constants, tuple(nodes), self.outputs)

    def replaced(self, nodes: Mapping[str, Sequence[Node]]) -> Graph:
        """The same values, with these nodes in the place of those that had made them."""
        return replace(self, nodes=tuple(new for node in self.nodes for new in nodes.get(node.name, [node])))

    def __str__(self) -> str:
        lines = ["inputs    " + ", ".join(f"%{n} : {t}" for n, t in self.inputs.items())]
        lines += ["constants " + ", ".join(f"%{n} : {t}" for n, t in self.constants.items())]
        lines += ["  " + str(node) for node in self.nodes]
        lines += ["outputs   " + ", ".join(f"%{n}" for n in self.outputs)]
        return "\n".join(lines)


def copied(name: str, value: str, type_: TensorType) -> Node:
    """What gives a value another name."""
    return Node(name, "aten.clone.default", (Ref(value),), (), (type_,))


def reshaped(name: str, value: str, type_: TensorType, source: str = "") -> Node:
    """What gives the numbers of a value, in their order, the shape of this type."""
    return Node(name, "aten.reshape.default", (Ref(value), type_.shape), (), (type_,), source)


def backward_slice(graph: Graph, outputs: tuple[str, ...], stops: Mapping[str, TensorType]) -> Graph:
    """The part of ``graph`` that computes ``outputs`` from ``stops`` and constants.

    Inputs of the result are the stops that it reads, in the order of ``stops``, and then inputs of ``graph``.
    """
    needed = set(outputs)
    for node in reversed(graph.nodes):
        if node.name in needed and node.name not in stops:
            needed.update(node.refs())
    candidates = {**stops, **graph.inputs}
    return Graph(
        inputs={n: t for n, t in candidates.items() if n in needed},
        constants={n: t for n, t in graph.constants.items() if n in needed and n not in stops},
        nodes=tuple(n for n in graph.nodes if n.name in needed and n.name not in stops),
        outputs=outputs,
    )


def _leaves(argument: Argument) -> Iterator[Argument]:
    if isinstance(argument, tuple):
        for item in argument:
            yield from _leaves(item)
    else:
        yield argument


def _map(argument: Argument, function: Callable[[Argument], Argument]) -> Argument:
    if isinstance(argument, tuple):
        return tuple(_map(item, function) for item in argument)
    return function(argument)


def _show(argument: Argument) -> str:
    if isinstance(argument, Ref):
        return f"%{argument.name}"
    if isinstance(argument, tuple):
        return "[" + ", ".join(map(_show, argument)) + "]"
    if isinstance(argument, Enum):
        return argument.name
    return str(argument)
