"""Invariants of graphs and programs, which the driver checks after capture and after every pass."""

from collections.abc import Container, Mapping

import numpy as np

from ..core.spec import PolicySpec
from ..errors import PassError
from .graph import Batch, Graph, Node, TensorType
from .pieces import PRUNER, STEM, STEP, TAIL, of_loop
from .program import DENOISER, Binding, Block, Cut, Loop, Phase, Pieces, Program


def verify_graph(graph: Graph, what: str) -> None:
    """Check one graph: names unique, values defined before use, outputs defined, results typed."""
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


def verify(program: Phase) -> None:
    """Check a whole program: every graph, every weight, and how the pieces fit together."""
    spec, denoiser = program.spec, program.denoiser
    expected = [spec.sample_argument, spec.timestep_argument, *spec.inputs]
    if list(denoiser.inputs) != expected:
        raise PassError(f"denoiser: inputs {list(denoiser.inputs)}; expected {expected}.")
    _verify_graphs({DENOISER: denoiser} if isinstance(program, Program) else program.graphs(), program)
    match program:
        case Program():
            verify_pieces(program)
        case Cut(blocks=blocks, loop=loop):
            _verify_loop(loop, blocks, spec)
            _verify_contexts(_readers(loop), program.prologue.outputs)


def verify_pieces(program: Program) -> None:
    """Check what is left of a program once it is compiled: its pieces, and what they are given."""
    _verify_graphs(program.pieces.graphs(), program)
    _verify_loop(program.pieces, program.blocks, program.spec)
    _verify_frames(program.pieces)
    _verify_loops(program, _verify_bindings(program.pieces))


def _verify_graphs(graphs: Mapping[str, Graph], program: Phase) -> None:
    for what, graph in graphs.items():
        verify_graph(graph, what)
        _verify_constants(graph, what, program)


def _verify_constants(graph: Graph, what: str, program: Phase) -> None:
    for name, type_ in graph.constants.items():
        weight = program.weights.get(name)
        if weight is None:
            raise PassError(f"{what}: constant %{name} has no value in the program's weights.")
        if weight.shape != type_.shape or str(weight.dtype) != type_.dtype:
            raise PassError(f"{what}: constant %{name} is {weight.dtype}{list(weight.shape)}; its type says {type_}.")


def _verify_loop(loop: Loop, blocks: tuple[Block, ...], spec: PolicySpec) -> None:
    for i, block in enumerate(blocks):
        if block.index != i:
            raise PassError(f"block table: entry {i} calls itself block {block.index}.")
    if len(loop.blocks) != len(blocks):
        raise PassError(f"{len(loop.blocks)} block graphs for {len(blocks)} rows of the block table.")
    stream, sample = blocks[0].type, TensorType((Batch(), *spec.sample), "float32")
    for what, piece in loop.loop.items():
        flows_in, flows_out = sample if what == STEM else stream, sample if what == TAIL else stream
        if (found := piece.graph.inputs.get(piece.stream)) != flows_in:
            raise PassError(f"{what}: its stream %{piece.stream} is {found}; expected {flows_in}.")
        given = [piece.graph.types()[output] for output in piece.graph.outputs]
        if given != [flows_out]:
            raise PassError(f"{what}: gives {list(map(str, given))}; expected one {flows_out}.")


def _readers(loop: Loop) -> dict[str, Mapping[str, TensorType]]:
    return {what: piece.contexts for what, piece in loop.loop.items()}


def _verify_contexts(readers: Mapping[str, Mapping[str, TensorType]], given: Container[str]) -> dict[str, TensorType]:
    """Type of every context."""
    types = dict[str, TensorType]()
    for what, contexts in readers.items():
        for name, type_ in contexts.items():
            if name not in given:
                raise PassError(f"{what}: nothing provides its context %{name} when it is read.")
            if types.setdefault(name, type_) != type_:
                raise PassError(f"{what}: its context %{name} is {type_}; to another piece it is {types[name]}.")
    return types


def _verify_bindings(pieces: Pieces) -> dict[str, TensorType]:
    """Type of every table."""
    step = () if pieces.step is None else pieces.step.outputs
    provided = {Binding.CONDITION: pieces.conditions, Binding.TABLE: pieces.tables, Binding.STEP: step}
    given = {name for name, binding in pieces.bindings.items() if name in provided.get(binding, ())}
    for name in pieces.features:
        if name not in pieces.conditions:
            raise PassError(f"pruner: its feature %{name} is not an output of the condition graph.")
    if pieces.pruner is not None and tuple(pieces.pruner.inputs) != pieces.features:
        raise PassError(f"pruner: reads {list(pieces.pruner.inputs)}; its features are {list(pieces.features)}.")
    others = {what: graph.inputs for what, graph in pieces.graphs().items() if what in (STEP, PRUNER)}
    types = _verify_contexts(_readers(pieces) | others, given)
    return {name: type_ for name, type_ in types.items() if pieces.bindings[name] is Binding.TABLE}


def _verify_loops(program: Program, tables: Mapping[str, TensorType]) -> None:
    """Every loop has rows of the tables for all of its steps, and a pruner of as many steps."""
    spec, pieces = program.spec, program.pieces
    if pieces.loop_tables.keys() != spec.loops.keys():
        raise PassError(f"tables of the loops {list(pieces.loop_tables)}; the policy has {list(spec.loops)}.")
    for loop, sampler in spec.all_loops.items():
        own = program.in_loop(loop)
        for name, type_ in tables.items():
            found = own.pieces.tables.get(name, np.zeros(0))
            if (str(found.dtype), found.shape) != (type_.dtype, (sampler.steps, *type_.at(1))):
                raise PassError(f"loop {loop}: the table of %{name} : {type_} is {found.dtype}{list(found.shape)}.")
        if (pruner := own.pieces.pruner) is not None:
            what = of_loop(PRUNER, loop)
            verify_graph(pruner, what)
            _verify_constants(pruner, what, own)
            steps = pruner.types()[pruner.outputs[0]].shape[1]
            if (tuple(pruner.inputs), steps) != (pieces.features, sampler.steps):
                told = f"of {steps} steps reads {list(pruner.inputs)}; expected {sampler.steps} steps"
                raise PassError(f"{what}: {told} and the features {list(pieces.features)}.")


def _verify_frames(pieces: Pieces) -> None:
    """Each tower reads its rows, and the condition graph what all of them give."""
    rows = [] if pieces.frames is None else list(pieces.frames.outputs)
    read = [name for tower in pieces.towers for name in tower.inputs]
    if read != rows:
        raise PassError(f"frames: gives the rows {rows}; the towers read {read}.")
    for tower in pieces.towers:
        for name in tower.outputs:
            if name not in {*pieces.condition.inputs, *(() if pieces.scene is None else pieces.scene.inputs)}:
                raise PassError(f"frames: %{name} of a tower is no input of the condition graph.")


def _around(graph: Graph, position: int, radius: int = 2) -> str:
    lines = []
    for i in range(max(0, position - radius), min(len(graph.nodes), position + radius + 1)):
        node: Node = graph.nodes[i]
        lines.append(f"  {'>' if i == position else ' '} {node}   # {node.place}")
    return "\n".join(lines)
