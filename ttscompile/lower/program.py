"""Graphs to ONNX models, by torch's own exporter.

A graph becomes a module whose weights are *inputs*, so that the exporter can neither fold nor rename them; the exporter
translates its operations, and ``name_model`` turns the weights' inputs into initializers without data.
"""

import logging
import operator
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from itertools import cycle, islice
from typing import Any

import numpy as np
import onnx
import torch
from torch.export.graph_signature import OutputKind, OutputSpec, TensorArgument

from ..errors import LoweringError
from ..ir.evaluate import resolve_enum, resolve_op, without_stack_traces
from ..ir.graph import Argument, Batch, Enum, Graph, Node, Ref, TensorType
from ..ir.layers import layers_graph
from ..ir.pieces import IDLE, LAYERS, PRUNER, TAIL, of_loop
from ..ir.program import Program
from .advance import advances, lower_idle
from .joint import lower_all_blocks
from .layout import sink_layout
from .onnx_model import name_model, only
from .promotion import beside_floats, may_promote, summed_as
from .simplify import simplify
from .translations import TRANSLATIONS

OPSET = 23
"""Has Gelu (20) and Attention (23), which is faster than what the exporter writes for 20 (``docs/decisions.md``)."""

_RESHAPE, _EXPAND = "aten.reshape.default", "aten.expand.default"

_EQUAL = {
    torch.ops.aten.__and__.Tensor: torch.ops.aten.bitwise_and.Tensor,
    torch.ops.aten.__or__.Tensor: torch.ops.aten.bitwise_or.Tensor,
}
"""What torch's exporter would take apart, everything else with it, to find the same operation by its other name."""

EXAMPLE_STREAMS = 3
"""Batch size while exporting; neither 0 nor 1, which torch.export would specialise on."""


def lower_program(program: Program) -> dict[str, onnx.ModelProto]:
    """The models of all pieces of a program.

    Returns:
        By name: ``condition``, ``step`` (if any), ``pruner`` (if any), ``stem``, ``block_00``, ``block_01``..,
        ``advance`` (tail, sampler update and stem in one; see ``lower.advance``), ``blocks`` and ``dense_step`` (all
        blocks in one; see ``ir.pieces.Joint``), if stem and tail allow it ``idle`` (see ``lower.advance``), and of one
        block alone ``layers`` (see ``ir.layers``). ``advance@NAME`` and ``pruner@NAME`` are those of a further loop,
        where they differ from the original's. Graphs of one structure are exported once.
    """
    pieces = program.pieces
    graphs = {name: graph for name, graph in pieces.graphs().items() if name != TAIL}
    inside = layers_graph(program)
    own = advances(program) | ({} if inside is None else {LAYERS: inside})
    own |= {of_loop(PRUNER, loop): graph for loop, graph in pieces.loop_pruners.items()}
    models = lower_graphs({**graphs, **own})
    idle, _ = lower_idle(pieces, program.weights, OPSET)
    return {**models, **lower_all_blocks(pieces.blocks, models), **({} if idle is None else {IDLE: idle})}


def structural_key(graph: Graph) -> str:
    """Equal for two graphs that differ in the names of their values only; independent of the process."""
    graph = _in_order_of_use(graph)
    names = {name: f"i{i}" for i, name in enumerate(graph.inputs)}
    names |= {name: f"c{i}" for i, name in enumerate(graph.constants)}
    names |= {node.name: f"n{i}" for i, node in enumerate(graph.nodes)}
    graph = graph.renamed(names)
    return repr(replace(graph, nodes=tuple(replace(node, source="") for node in graph.nodes)))


def lower_graphs(graphs: dict[str, Graph]) -> dict[str, onnx.ModelProto]:
    """ONNX models of graphs, by name.

    Inputs and outputs are called as in the graph; sizes ``Batch(c)`` are the dynamic dimension ``c*B``. Each constant
    that is read is an initializer of the constant's name with dtype and dims and no data: ``artifact.bind`` points it
    into a weights file. The bytes depend on the graph and the versions of torch and onnxscript alone.
    """
    for name, graph in graphs.items():
        if len(set(graph.outputs)) != len(graph.outputs):
            raise LoweringError(f"{name}: the outputs {graph.outputs} hold a value twice; give each a name of its own.")
    sunk = {name: _in_order_of_use(sink_layout(graph)) for name, graph in graphs.items()}
    keys = {name: structural_key(graph) for name, graph in sunk.items()}
    first = {keys[name]: name for name in reversed(sunk)}
    exported = _export({name: sunk[name] for name in sorted(first.values())})
    models = {}
    for name, graph in graphs.items():
        types = graph.types()
        inputs, constants = list(sunk[name].inputs.items()), list(sunk[name].constants.items())
        outputs = [(output, types[output]) for output in graph.outputs]
        models[name] = name_model(exported[first[keys[name]]], name, inputs, constants, outputs)
    return models


def _in_order_of_use(graph: Graph) -> Graph:
    used = dict.fromkeys(name for node in graph.nodes for name in node.refs() if name in graph.constants)
    order = [*used, *(name for name in graph.constants if name not in used)]
    return replace(graph, constants={name: graph.constants[name] for name in order})


def _export(graphs: dict[str, Graph]) -> dict[str, onnx.ModelProto]:
    """What torch's exporter makes of each graph, its inputs and then its constants as inputs.

    The graphs go through the exporter side by side, as one module: most of what an export takes does not depend on
    its size. If that fails they go one by one, so that the message can name the piece.
    """
    try:
        joint = _run_exporter(list(graphs.values()))
    except Exception as error:  # torch.export and the exporter raise whatever their machinery raises
        if len(graphs) > 1:
            return {name: _export({name: graph})[name] for name, graph in graphs.items()}
        ((name, graph),) = graphs.items()
        operations = ", ".join(sorted({node.op for node in graph.nodes}))
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        raise LoweringError(
            f"piece {name!r} could not be exported to ONNX opset {OPSET}: {str(cause).strip().splitlines()[0]}"
            f" Its operations are {operations}. Write the one that has no ONNX form as plain tensor code in the module."
        ) from error
    inputs, outputs = iter(joint.graph.input), iter(joint.graph.output)
    return {
        name: only(joint, list(islice(inputs, len(g.inputs) + len(g.constants))), list(islice(outputs, len(g.outputs))))
        for name, g in graphs.items()
    }


def _run_exporter(graphs: list[Graph]) -> onnx.ModelProto:
    """One model of several graphs that have nothing in common but the file; each has a batch size of its own."""
    examples: list[torch.Tensor] = []
    dynamic: list[dict[int, Any]] = []
    for i, graph in enumerate(graphs):
        streams = torch.export.Dim(f"B{i}", min=1)
        for type_ in (*graph.inputs.values(), *graph.constants.values()):
            # numpy's zeros take no memory until they are written, which these never are; torch's take it at once.
            examples.append(torch.from_numpy(np.zeros(type_.at(EXAMPLE_STREAMS), type_.dtype)))
            sizes = [(axis, n.multiple) for axis, n in enumerate(type_.shape) if isinstance(n, Batch)]
            dynamic.append({axis: multiple * streams if multiple > 1 else streams for axis, multiple in sizes})
    with _quiet(), torch.no_grad():
        given = _Arguments(sum(len(graph.outputs) for graph in graphs))
        program = torch.export.export(given, tuple(examples), dynamic_shapes=(tuple(dynamic),), strict=False)
        _write(program, graphs)
        table = dict(TRANSLATIONS)
        result = torch.onnx.export(
            program, (), opset_version=OPSET, verbose=False, custom_translation_table=table, optimize=False
        )
        assert result is not None
        simplify(result.model)
        return result.model_proto


class _Arguments(torch.nn.Module):
    """Gives so many of its arguments. ``_write`` writes what is between: tracing that took most of a conversion."""

    def __init__(self, results: int) -> None:
        super().__init__()
        self._results = results

    def forward(self, *values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(islice(cycle(values), self._results))


class _Written(torch.export.ExportedProgram):
    """A program whose operations were written, not traced."""

    def run_decompositions(self, decomp_table: Any = None, **more: Any) -> torch.export.ExportedProgram:
        """As torch's, which traces everything again, unless the table takes none of the operations apart."""
        known = decomp_table or {}
        if any(node.op == "call_function" and node.target in known for node in self.graph.nodes):
            with without_stack_traces():
                made: torch.export.ExportedProgram = super().run_decompositions(decomp_table, **more)
                return made
        return self


def _write(program: torch.export.ExportedProgram, graphs: list[Graph]) -> None:
    """Write the operations of graphs, whose types are known, behind the arguments of a traced program."""
    graph = program.graph_module.graph
    for node in reversed(graph.nodes):
        if node.op != "placeholder":
            graph.erase_node(node)
    arguments, results = iter(list(graph.nodes)), list[torch.fx.Node]()
    for each in graphs:
        given = dict(zip((*each.inputs, *each.constants), arguments, strict=False))  # as many as it has
        results += _Writer(graph, each, given).results()
    graph.output(tuple(results))
    program.graph_module.recompile()
    outputs = [OutputSpec(OutputKind.USER_OUTPUT, TensorArgument(node.name), None) for node in results]
    program.graph_signature.output_specs[:] = outputs
    program.__class__ = _Written
    if not any(may_promote(graph) for graph in graphs):
        # The exporter looks through these for types that are promoted, and for assertions: there are none of either.
        program.graph_module.modules = list


class _Writer:
    """Writes the operations of one graph into a graph of torch's."""

    def __init__(self, target: torch.fx.Graph, graph: Graph, given: Mapping[str, torch.fx.Node]) -> None:
        self._target, self._graph, self._values = target, graph, dict(given)
        self._fake = next(iter(given.values())).meta["val"].fake_mode
        self._sizes: dict[int, torch.fx.Node] = {}
        self._streams: Any = 1
        for name, type_ in graph.inputs.items():
            batch = next(
                ((axis, size.multiple) for axis, size in enumerate(type_.shape) if isinstance(size, Batch)), None
            )
            if batch is not None:  # the number of streams is read from the first input that has it
                axis, multiple = batch
                size = given[name].meta["val"].shape[axis]
                self._streams = size // multiple
                self._sizes[multiple] = self._call(torch.ops.aten.sym_size.int, (given[name], axis), size)
                if multiple != 1:
                    self._sizes[1] = self._call(operator.floordiv, (self._sizes[multiple], multiple), self._streams)
                break

    def results(self) -> list[torch.fx.Node]:
        """Write all of them; the graph's outputs."""
        types = self._graph.types()
        for node in self._graph.nodes:
            given = [beside_floats(node, each, types) for each in _without_symbols(node, types)]
            args = [self._argument(node, each) for each in given]
            if (dtype := summed_as(node, types)) is not None:
                kind = getattr(torch, dtype)
                args[0] = self._call(
                    torch.ops.aten._to_copy.default, (args[0],), args[0].meta["val"].to(kind), {"dtype": kind}
                )
            named = {name: self._argument(node, each) for name, each in node.kwargs}
            function: Any = resolve_op(node)
            function = _EQUAL.get(function, function)
            made = [self._tensor(type_) for type_ in node.types]
            returns = getattr(function, "_schema", None)
            several = returns is not None and (len(made) > 1 or isinstance(returns.returns[0].type, torch.ListType))
            self._values[node.name] = self._call(function, tuple(args), made if several else made[0], named)
        return [self._values[name] for name in self._graph.outputs]

    def _call(self, function: Any, args: tuple[Any, ...], value: Any, named: Any = None) -> torch.fx.Node:
        node = self._target.call_function(function, args, named)
        node.meta |= {"val": value, "nn_module_stack": {}}
        return node

    def _tensor(self, type_: TensorType) -> torch.Tensor:
        shape = [self._streams * size.multiple if isinstance(size, Batch) else size for size in type_.shape]
        with self._fake:
            return torch.empty(shape, dtype=getattr(torch, type_.dtype))

    def _argument(self, node: Node, argument: Argument) -> Any:
        match argument:
            case Ref(name):
                return self._values[name]
            case Batch(multiple):
                if multiple not in self._sizes:
                    once = self._sizes[1]
                    self._sizes[multiple] = self._call(operator.mul, (once, multiple), once.meta["val"] * multiple)
                return self._sizes[multiple]
            case Enum():
                return resolve_enum(node, argument, torch.device("cpu"))
            case tuple():
                return [self._argument(node, each) for each in argument]
        return argument


def _without_symbols(node: Node, types: dict[str, TensorType]) -> tuple[Argument, ...]:
    """The arguments with -1 for a batch size where that means the same: the shape is then a constant in the model."""
    match node.args:
        case (Ref(_) as value, tuple(shape)) if node.op == _RESHAPE and sum(isinstance(n, Batch) for n in shape) == 1:
            return (value, tuple(-1 if isinstance(n, Batch) else n for n in shape))
        case (Ref(name) as value, tuple(shape), *rest) if node.op == _EXPAND:
            before = (None,) * (len(shape) - len(types[name].shape)) + types[name].shape
            kept = tuple(-1 if isinstance(n, Batch) and n == b else n for n, b in zip(shape, before, strict=True))
            return (value, kept, *rest)
    return node.args


@contextmanager
def _quiet() -> Iterator[None]:
    """Without torch's warnings about its own internals, and about torchvision, which is not needed."""
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
