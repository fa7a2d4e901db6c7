"""Invariants of graphs and programs, which the driver checks after capture and after every pass."""

from __future__ import annotations

from collections.abc import Iterator

from ..errors import PassError
from .graph import Graph, Node
from .program import Binding, Program


def verify_graph(graph: Graph, what: str) -> None:
    """Check one graph: names unique, values defined before use, outputs defined, results typed.

    Raises:
        PassError: names the graph, the node with its source line, and its neighbours.
    """
    if both := sorted(graph.inputs.keys() & graph.constants.keys()):
        raise PassError(f"{what}: %{both[0]} is both an input and a constant.")
    defined = {*graph.inputs, *graph.constants}
    for position, node in enumerate(graph.nodes):
        if node.name in defined:
            raise PassError(f"{what}: %{node.name} is defined twice.\n{_around(graph, position)}")
        for name in node.refs():
            if name not in defined:
                where = _around(graph, position)
                raise PassError(f"{what}: %{node.name} reads %{name}, which is not defined there.\n{where}")
        if not node.types:
            raise PassError(f"{what}: %{node.name} has no result.\n{_around(graph, position)}")
        defined.add(node.name)
    for name in graph.outputs:
        if name not in defined:
            raise PassError(f"{what}: the output %{name} is not defined; {len(graph.nodes)} nodes.")


def verify(program: Program) -> None:
    """Check a whole program: every graph, every weight, and how the pieces fit together.

    Raises:
        PassError: what does not hold, where.
    """
    spec, denoiser = program.spec, program.denoiser
    expected = [spec.sample_argument, spec.timestep_argument, *spec.observations]
    if list(denoiser.inputs) != expected:
        raise PassError(f"denoiser: inputs {list(denoiser.inputs)}; expected {expected}.")
    for what, graph in graphs(program):
        verify_graph(graph, what)
        for name, type_ in graph.constants.items():
            weight = program.weights.get(name)
            if weight is None:
                raise PassError(f"{what}: constant %{name} has no value in the program's weights.")
            if weight.shape != type_.shape or str(weight.dtype) != type_.dtype:
                found = f"{weight.dtype}{list(weight.shape)}"
                raise PassError(f"{what}: constant %{name} is {found}; its type says {type_}.")
    for i, block in enumerate(program.blocks):
        if block.index != i:
            raise PassError(f"block table: entry {i} calls itself block {block.index}.")
    if program.pieces is not None:
        _verify_pieces(program)
    if program.reuse and len(program.reuse) != len(program.blocks):
        raise PassError(f"{len(program.reuse)} reuse branches for {len(program.blocks)} blocks.")


def graphs(program: Program) -> Iterator[tuple[str, Graph]]:
    """Every graph of a program with its name."""
    yield "denoiser", program.denoiser
    pieces = program.pieces
    if pieces is None:
        return
    yield "condition", pieces.condition
    if pieces.step is not None:
        yield "step", pieces.step
    yield "stem", pieces.stem
    for i, block in enumerate(pieces.blocks):
        yield f"block {i}", block
    yield "tail", pieces.tail
    if pieces.pruner is not None:
        yield "pruner", pieces.pruner


def _verify_pieces(program: Program) -> None:
    pieces = program.pieces
    assert pieces is not None
    if len(pieces.blocks) != len(program.blocks):
        raise PassError(f"{len(pieces.blocks)} block graphs for {len(program.blocks)} rows of the block table.")
    stream = program.blocks[0].type
    loop = [("stem", pieces.stem, program.denoiser.inputs[program.spec.sample_argument], stream)]
    loop += [(f"block {i}", graph, stream, stream) for i, graph in enumerate(pieces.blocks)]
    loop += [("tail", pieces.tail, stream, program.denoiser.inputs[program.spec.sample_argument])]
    for what, graph, flows_in, flows_out in loop:
        first = next(iter(graph.inputs.values()), None)
        if first != flows_in:
            raise PassError(f"{what}: its first input is {first}; expected {flows_in}.")
        if len(graph.outputs) != 1 or graph.types()[graph.outputs[0]] != flows_out:
            given = [str(graph.types()[o]) for o in graph.outputs]
            raise PassError(f"{what}: gives {given}; expected one {flows_out}.")
    provided = {Binding.CONDITION: set(pieces.condition.outputs), Binding.TABLE: set(pieces.tables)}
    provided[Binding.STEP] = set(pieces.step.outputs) if pieces.step is not None else set()
    consumers = [(what, list(graph.inputs)[1:]) for what, graph, _, _ in loop]
    if pieces.step is not None:
        consumers.append(("step", list(pieces.step.inputs)))
    for what, contexts in consumers:
        for name in contexts:
            # Before hoist every context comes from the prologue.
            binding = pieces.bindings.get(name) if pieces.bindings else Binding.CONDITION
            if binding is None or name not in provided.get(binding, ()):
                raise PassError(f"{what}: nothing provides its context %{name} (binding {binding}).")
    for name in pieces.features:
        if name not in pieces.condition.outputs:
            raise PassError(f"pruner: its feature %{name} is not an output of the condition graph.")
    if pieces.pruner is not None and tuple(pieces.pruner.inputs) != pieces.features:
        raise PassError(f"pruner: reads {list(pieces.pruner.inputs)}; its features are {list(pieces.features)}.")


def _around(graph: Graph, position: int, radius: int = 2) -> str:
    lines = []
    for i in range(max(0, position - radius), min(len(graph.nodes), position + radius + 1)):
        node: Node = graph.nodes[i]
        lines.append(f"  {'>' if i == position else ' '} {node}   # {node.source or 'source unknown'}")
    return "\n".join(lines)
