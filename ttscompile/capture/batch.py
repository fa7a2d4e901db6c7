"""The batch as a symbol, found among the numbers of a graph that was captured with a batch size rare among them.

torch.export can reason about a symbolic batch, and gives up where it cannot prove something that is true, as of a
doubled batch's ``chunk(2, 0)``. With numbers there is nothing to prove: ``107 * c`` is ``c * B``. A network may have
such a number of its own, so all shapes are then computed for two streams. Where they differ, another number is tried.
"""

from collections.abc import Mapping
from dataclasses import replace

import torch

from ..errors import CaptureError
from ..ir.evaluate import Evaluator, resolve_op
from ..ir.graph import GETITEM, Argument, Batch, Graph, Size, TensorType

BATCHES = (107, 109)
"""Batch sizes to capture with, the second if the first does not do: few numbers of networks are a multiple of one."""

REMEDY = " Every stream of a batch must be computed alike, whatever their number: no loop or branch on the batch size."


def with_batch(graph: Graph, batch: int) -> Graph:
    """The graph for every batch size, of one captured with this one, of which no other number may be a multiple.

    Raises:
        CaptureError: a size is no multiple of it, or a multiple of it may be something else; names the first such node.
    """

    def size(number: Size) -> Size:
        assert isinstance(number, int)
        return Batch(number // batch) if number and not number % batch else number  # negative: from the end

    def argument(leaf: Argument) -> Argument:
        return size(leaf) if type(leaf) is int else leaf

    found = graph.mapped(argument, lambda type_: replace(type_, shape=tuple(map(size, type_.shape))))
    found = replace(found, constants=graph.constants)
    _require_sizes(found, graph, batch)
    return found


def _require_sizes(graph: Graph, captured: Graph, batch: int) -> None:
    for node in graph.nodes:  # a number that is no size; a size that is none has a wrong shape
        if node.op != GETITEM and not node.op.startswith("aten.arange."):
            kinds = {a.name: str(a.type) for a in resolve_op(node)._schema.arguments}  # type: ignore[attr-defined]
            given = [*zip(kinds, node.args, strict=False), *node.kwargs]
            if any(isinstance(value, Batch) and "int" not in kinds[name] for name, value in given):
                raise CaptureError(f"%{node.name} ({node.source}) computes with a multiple of {batch}.{REMEDY}")
    run = Evaluator(replace(graph, outputs=tuple(node.name for node in graph.nodes)), _of_two(graph.constants), "meta")
    for node, before, value in zip(graph.nodes, captured.nodes, run(_of_two(graph.inputs)), strict=True):
        # Of what gives several values each is looked at where it is taken.
        if isinstance(value, torch.Tensor) and tuple(value.shape) != node.type.at(2):
            raise CaptureError(
                f"a size at %{node.name} ({node.source}) is not a multiple of the batch size: it has the shape"
                f" {tuple(before.type.shape)} for {batch} streams and {tuple(value.shape)} for 2. Only the batch may"
                " vary; write the other sizes as numbers."
            )


def _of_two(types: Mapping[str, TensorType]) -> dict[str, torch.Tensor]:
    return {n: torch.empty(t.at(2), dtype=getattr(torch, t.dtype), device="meta") for n, t in types.items()}
