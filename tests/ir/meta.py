"""Are the types that a graph records what torch's own shape functions give?"""

from dataclasses import replace

import torch

from ttscompile.ir.evaluate import Evaluator
from ttscompile.ir.graph import GETITEM, Graph, Ref, TensorType
from ttscompile.ir.program import Phase


def assert_types(graph: Graph, what: str) -> None:
    """Every node's recorded type is that of its value on meta tensors, for two numbers of streams.

    Args:
        graph: any graph.
        what: its name, for messages.
    """
    producers = graph.producers()
    single = [node for node in graph.nodes if len(node.types) == 1]
    for node in single:
        if node.op == GETITEM:
            source, index = node.args
            assert isinstance(source, Ref) and isinstance(index, int)
            assert node.type == producers[source.name].types[index], f"{what}: {node}"
    run = Evaluator(
        replace(graph, outputs=tuple(node.name for node in single)),
        {name: _meta(type_, 1) for name, type_ in graph.constants.items()},
        device="meta",
    )
    for streams in (3, 5):
        values = run({name: _meta(type_, streams) for name, type_ in graph.inputs.items()})
        for node, given in zip(single, values, strict=True):
            value = given[0] if isinstance(given, list | tuple) else given  # of one part
            found = (tuple(value.shape), str(value.dtype).removeprefix("torch."))
            assert found == (node.type.at(streams), node.type.dtype), f"{what}: {node}, {streams} streams: {found}"


def assert_types_of(program: Phase) -> None:
    """The same of the denoiser and of every piece of it."""
    for what, graph in program.graphs().items():
        assert_types(graph, what)


def _meta(type_: TensorType, streams: int) -> torch.Tensor:
    return torch.empty(type_.at(streams), dtype=getattr(torch, type_.dtype), device="meta")
