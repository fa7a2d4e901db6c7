"""Cut a doubled batch into its copies without a size that only the call knows: ONNX wants numbers to cut at."""

from collections.abc import Mapping
from dataclasses import replace

from ttscompile.ir.graph import GETITEM, Argument, Batch, Node, Ref, TensorType, reshaped
from ttscompile.ir.program import Captured

from .base import Pass, PassResult

_SPLITS = ("aten.split.Tensor", "aten.split_with_sizes.default")


class CutCopies(Pass[Captured, Captured]):
    """Select whole copies of the batch by their number.

    Before::

        %given = aten.slice.Tensor(%both, 0, 0, B)                      # %both : [2*B, T, D]
        %free  = aten.slice.Tensor(%both, 0, B, 2*B)                    # or split, or chunk

    After::

        %both.copies = aten.reshape.default(%both, [2, B, T, D])
        %given       = aten.select.int(%both.copies, 0, 0)
        %free        = aten.select.int(%both.copies, 0, 1)
    """

    def call(self, program: Captured) -> PassResult[Captured]:
        graph = program.denoiser
        types, producers = graph.types(), graph.producers()
        cuts: dict[str, list[Node]] = {}
        made: set[str] = set()
        for node in graph.nodes:
            found = _slice(node, types) if node.op == "aten.slice.Tensor" else _item(node, producers, types)
            if found is not None:
                cuts[node.name] = _cut(node, types[found[0]], *found, made)
        if not cuts:
            return PassResult(program)
        nodes = graph.replaced(cuts).nodes
        read = {name for node in nodes for name in node.refs()} | set(graph.outputs)
        kept = tuple(n for n in nodes if n.op not in _SPLITS or n.name in read)
        new = replace(program, denoiser=replace(graph, nodes=kept))
        return PassResult(new, (f"{len(cuts)} cuts of a multiple of the batch",))


_Found = tuple[str, int, int, int]
"""What is cut, the axis, and the first copy and the one after the last."""


def _axis(type_: TensorType, argument: Argument) -> int | None:
    if not isinstance(argument, int):
        return None
    axis = argument % len(type_.shape)
    return axis if isinstance(type_.shape[axis], Batch) else None


def _multiple(size: Argument, of: Batch) -> int | None:
    """How many batches a boundary lies from the start; a negative one is counted from the end, as in Python."""
    if isinstance(size, Batch):
        return min(max(size.multiple + of.multiple * (size.multiple < 0), 0), of.multiple)
    if size is None or (isinstance(size, int) and size >= 2**31):
        return of.multiple
    return 0 if size == 0 else None


def _slice(node: Node, types: Mapping[str, TensorType]) -> _Found | None:
    source = node.args[0]
    assert isinstance(source, Ref)
    axis = _axis(types[source.name], node.argument(1, 0))
    if axis is None or node.argument(4, 1) != 1:
        return None
    whole = types[source.name].shape[axis]
    assert isinstance(whole, Batch)
    first = node.argument(2)
    start, stop = _multiple(0 if first is None else first, whole), _multiple(node.argument(3), whole)
    if start is None or stop is None or (start, stop) == (0, whole.multiple):
        return None
    return source.name, axis, start, stop


def _item(node: Node, producers: Mapping[str, Node], types: Mapping[str, TensorType]) -> _Found | None:
    if node.op != GETITEM or not isinstance(node.args[0], Ref) or not isinstance(node.args[1], int):
        return None
    split = producers.get(node.args[0].name)
    if split is None or split.op not in _SPLITS or not isinstance(split.args[0], Ref):
        return None
    source = split.args[0].name
    axis = _axis(types[source], split.argument(2, 0))
    if axis is None:
        return None
    multiples = [size.multiple for part in split.types if isinstance(size := part.shape[axis], Batch)]
    if len(multiples) < len(split.types):
        return None
    start = sum(multiples[: node.args[1]])
    return source, axis, start, start + multiples[node.args[1]]


def _cut(node: Node, type_: TensorType, source: str, axis: int, start: int, stop: int, made: set[str]) -> list[Node]:
    whole = type_.shape[axis]
    assert isinstance(whole, Batch)
    of_copies = type_.with_axis(axis, whole.multiple, Batch())
    copies, nodes = f"{source}.copies{axis}", []
    if copies not in made:
        made.add(copies)
        nodes.append(reshaped(copies, source, of_copies, node.source))
    if stop - start == 1:
        return [*nodes, Node(node.name, "aten.select.int", (Ref(copies), axis, start), (), node.types, node.source)]
    some = of_copies.with_axis(axis, stop - start)
    part = Node(f"{node.name}.part", "aten.slice.Tensor", (Ref(copies), axis, start, stop), (), (some,), node.source)
    return [*nodes, part, reshaped(node.name, part.name, node.type, node.source)]
