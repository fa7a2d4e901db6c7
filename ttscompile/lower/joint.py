"""ONNX models that hold all residual blocks: one runs any of them, the other all in a row; see ``ir.pieces.Joint``."""

from collections.abc import Mapping, Sequence

from onnx import GraphProto, ModelProto, NodeProto, TensorProto, ValueInfoProto, helper

from ..ir import pieces as names
from ..ir.graph import TensorType
from ..ir.pieces import halves, join
from .onnx_model import opsets, own_model, value_info


def lower_all_blocks(blocks: Sequence[names.LoopPiece], models: Mapping[str, ModelProto]) -> dict[str, ModelProto]:
    """The two models by name, given the models of the blocks; others in ``models`` are not looked at."""
    own = [models[names.block_name(b)] for b in range(len(blocks))]
    return {names.JOINT: _join_blocks(blocks, own), names.DENSE_STEP: _chain_blocks(blocks, own)}


def _join_blocks(blocks: Sequence[names.LoopPiece], own: Sequence[ModelProto]) -> ModelProto:
    """The model that runs any of the blocks.

    Weights stay in the branch that reads them: onnxruntime packs them only there, and without it a block takes twice
    as long. They are initializers without data, as in the models of the blocks, and of the same names.
    """
    joint = join([tuple(piece.contexts.values()) for piece in blocks])
    # Runtimes refuse a stream that changes its type; the sizes that are declared here then are those of every block.
    hidden = blocks[0].type

    def branch(first: int, stop: int, depth: int) -> GraphProto:
        name = f"{names.RESIDUAL}.{first}.{stop}" if depth else names.RESIDUAL
        output = value_info(name, hidden)
        if stop - first == 1:
            places = dict(zip(blocks[first].contexts, joint.places[first], strict=True))
            return _leaf(own[first], {blocks[first].stream: names.STREAM, **places}, output, f"b{first}")
        middle = halves(first, stop)
        then, other = branch(first, middle, depth + 1), branch(middle, stop, depth + 1)
        node = helper.make_node(
            "If", [joint.switches[depth]], [name], name=f"if.{first}.{stop}", then_branch=then, else_branch=other
        )
        return GraphProto(name=f"blocks.{first}.{stop}", node=[node], output=[output])

    root = branch(0, len(own), 0)
    inputs = [value_info(name, TensorType((), "bool")) for name in joint.switches]
    inputs += [value_info(name, type_) for name, type_ in ((names.STREAM, hidden), *joint.slots)]
    graph = GraphProto(name=names.JOINT, node=root.node, input=inputs, output=root.output, initializer=root.initializer)
    return own_model(graph, opsets(own))


def _chain_blocks(blocks: Sequence[names.LoopPiece], own: Sequence[ModelProto]) -> ModelProto:
    hidden = blocks[0].type
    contexts = {name: type_ for piece in blocks for name, type_ in piece.contexts.items()}
    nodes: list[NodeProto] = []
    weights: dict[str, TensorProto] = {}
    before = names.STREAM
    last, *residuals = names.dense_step_outputs(len(blocks))
    for b, (block, model, residual) in enumerate(zip(blocks, own, residuals, strict=True)):
        inputs = {block.stream: before, **{name: names.CONTEXT + name for name in block.contexts}}
        leaf = _leaf(model, inputs, value_info(residual, hidden), f"b{b}")
        small = {tensor.name: f"b{b}.{tensor.name}" for tensor in leaf.initializer if tensor.raw_data}
        for tensor in leaf.initializer:
            tensor.name = small.get(tensor.name, tensor.name)
            weights[tensor.name] = tensor
        for node in leaf.node:
            node.input[:] = [small.get(value, value) for value in node.input]
        after = last if b == len(blocks) - 1 else f"{names.STREAM}.{b}"
        nodes += [*leaf.node, helper.make_node("Add", [before, residual], [after], name=f"add.{b}")]
        before = after
    types = {names.STREAM: hidden, **{names.CONTEXT + name: type_ for name, type_ in contexts.items()}}
    given = [value_info(name, type_) for name, type_ in types.items()]
    made = [value_info(name, hidden) for name in (last, *residuals)]
    graph = GraphProto(name=names.DENSE_STEP, node=nodes, input=given, output=made, initializer=weights.values())
    return own_model(graph, opsets(own))


def _leaf(model: ModelProto, inputs: Mapping[str, str], output: ValueInfoProto, prefix: str) -> GraphProto:
    """A block as a branch: in place of its own inputs it reads those of the graph around it."""
    graph = model.graph
    weights = {tensor.name for tensor in graph.initializer}
    called = {"": "", **inputs, **{name: name for name in weights}}
    called[graph.output[0].name] = output.name
    nodes = []
    for node in graph.node:
        copy = NodeProto()
        copy.CopyFrom(node)
        copy.name = f"{prefix}.{node.name}"
        copy.input[:] = [called.get(value, f"{prefix}.{value}") for value in node.input]
        copy.output[:] = [called.get(value, f"{prefix}.{value}") for value in node.output]
        nodes.append(copy)
    return GraphProto(name=model.graph.name, node=nodes, initializer=graph.initializer, output=[output])
