"""From what torch's exporter writes to the ONNX model of a piece: our names, weights without data, nothing else."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import count

import onnx
from onnx import AttributeProto, GraphProto, ModelProto, NodeProto, TensorProto, ValueInfoProto, helper

from ..errors import LoweringError
from ..ir.graph import Batch, TensorType

Values = Sequence[tuple[str, TensorType]]

IR_VERSION = 10
"""ONNX IR version of what is written; the lowest that allows the opset, for the sake of older onnxruntimes."""


def name_model(exported: ModelProto, name: str, inputs: Values, constants: Values, outputs: Values) -> ModelProto:
    """A model with the values of a graph in place of the exporter's.

    Nodes are numbered, values in between are called ``v0, v1..``, constants that the exporter made ``k0, k1..`` in the
    order of their first use; documentation, metadata, shapes of inner values and unused domains are dropped. The
    result depends on the exported operations and the arguments alone.

    Args:
        exported: its inputs are the inputs and then the constants, by position.
        constants: name and type of each weight. Each becomes an initializer of this name with dtype and dims and *no
            data*; the writer of the artifact gives it a place in a weights file (``artifact.bind``).
        outputs: name and type of each output; an output may be an input or a constant.
    """
    graph = exported.graph
    if exported.functions:
        raise LoweringError(f"{name}: the exporter left functions {[f.name for f in exported.functions]} in the model.")
    names = {value.name: own for value, (own, _) in zip(graph.input, [*inputs, *constants], strict=True)}
    bound = set(names.values())
    made = {tensor.name: tensor for tensor in graph.initializer}
    computed = {value for node in graph.node for value in node.output if value}
    aliases: list[NodeProto] = []
    needed: set[str] = set()
    for value, (own, _) in zip(graph.output, outputs, strict=True):
        if own in bound:
            continue  # an input or constant that is an output needs no node
        result = value.name
        if result not in computed or result in names:
            result = f"output {own}"  # no name of the exporter's has a blank
            aliases.append(helper.make_node("Identity", [value.name], [result]))
        names[result] = own
        needed.add(result)
    live = live_nodes([*graph.node, *aliases], needed)
    taken = bound | {own for own, _ in outputs}
    counter = _fresh_names("v", taken)
    for node in live:
        for value in node.output:
            if value and value not in names:
                names[value] = next(counter)
    counter = _fresh_names("k", taken | set(names.values()))
    kept: dict[bytes, TensorProto] = {}
    nodes = []
    for index, node in enumerate(live):
        for value in node.input:
            if value in made and value not in names:
                names[value] = _shared(made[value], kept, counter)
        nodes.append(_renamed(node, f"n{index}", names, name))
    types = dict(constants)
    read = {value for node in nodes for value in node.input} | {own for own, _ in outputs}
    empty = [TensorProto(name=c, dims=t.at(1), data_type=_dtype(t)) for c, t in types.items() if c in read]
    domains = {node.domain for node in nodes} | {""}
    own_graph = GraphProto(
        name=name,
        input=[value_info(own, type_) for own, type_ in inputs],
        output=[value_info(own, type_) for own, type_ in outputs],
        initializer=[*empty, *kept.values()],
        node=nodes,
    )
    return own_model(own_graph, [o for o in exported.opset_import if o.domain in domains])


def own_model(graph: GraphProto, opset_import: Iterable[onnx.OperatorSetIdProto]) -> ModelProto:
    """A graph of ours as a model."""
    return ModelProto(ir_version=IR_VERSION, producer_name="ttscompile", opset_import=opset_import, graph=graph)


def only(model: ModelProto, inputs: Sequence[ValueInfoProto], outputs: Sequence[ValueInfoProto]) -> ModelProto:
    """The part of a model that computes ``outputs`` from ``inputs``; both are the model's own."""
    nodes = live_nodes(list(model.graph.node), {value.name for value in outputs})
    own = {value.name for value in inputs}
    foreign = {value.name for value in model.graph.input} - own
    for node in nodes:
        if crossed := foreign.intersection(node.input):
            raise LoweringError(f"{node.op_type} {node.name!r} reads {sorted(crossed)}, the input of another piece.")
    return replaced(model, node=nodes, input=inputs, output=outputs)


def replaced(model: ModelProto, **fields: Sequence[NodeProto | TensorProto | ValueInfoProto]) -> ModelProto:
    """A copy of a model whose graph has these nodes, initializers, inputs or outputs in place of its own."""
    copy = ModelProto()
    copy.CopyFrom(model)
    for field, values in fields.items():
        copy.graph.ClearField(field)
        getattr(copy.graph, field).extend(values)
    return copy


def live_nodes(nodes: Sequence[NodeProto], outputs: set[str]) -> list[NodeProto]:
    """The nodes that outputs depend on."""
    needed = set(outputs)
    live = []
    for node in reversed(nodes):
        if needed.intersection(node.output):
            live.append(node)
            needed.update(filter(None, node.input))  # one that is left out has no name
    return live[::-1]


def opsets(models: Iterable[ModelProto]) -> list[onnx.OperatorSetIdProto]:
    """The newest opset of each domain that the models use."""
    newest: dict[str, int] = {}
    for entry in (entry for model in models for entry in model.opset_import):
        newest[entry.domain] = max(entry.version, newest.get(entry.domain, 0))
    return [helper.make_opsetid(domain, version) for domain, version in sorted(newest.items())]


def value_info(name: str, type_: TensorType) -> ValueInfoProto:
    """A value's name and type; sizes that depend on the batch are dynamic dimensions."""
    shape = [str(n) if isinstance(n, Batch) else n for n in type_.shape]
    return helper.make_tensor_value_info(name, _dtype(type_), shape)


def _shared(tensor: TensorProto, kept: dict[bytes, TensorProto], names: Iterator[str]) -> str:
    data = onnx.numpy_helper.to_array(tensor).tobytes()
    key = f"{tensor.data_type} {list(tensor.dims)} ".encode() + data
    if key not in kept:
        kept[key] = TensorProto(name=next(names), dims=tensor.dims, data_type=tensor.data_type, raw_data=data)
    return kept[key].name


def _renamed(node: NodeProto, name: str, names: dict[str, str], model: str) -> NodeProto:
    for attribute in node.attribute:
        if attribute.type in (AttributeProto.GRAPH, AttributeProto.GRAPHS):
            raise LoweringError(f"{model}: {node.op_type} has a subgraph. Control flow on data cannot be compiled.")
    inputs, outputs = ([names.get(value, value) for value in values] for values in (node.input, node.output))
    renamed = NodeProto(name=name, op_type=node.op_type, domain=node.domain, input=inputs, output=outputs)
    for attribute in sorted(node.attribute, key=lambda a: a.name):
        renamed.attribute.add().CopyFrom(attribute)
        renamed.attribute[-1].ClearField("doc_string")
    return renamed


def _fresh_names(prefix: str, taken: set[str]) -> Iterator[str]:
    return (name for name in (f"{prefix}{number}" for number in count()) if name not in taken)


def _dtype(type_: TensorType) -> int:
    names = {"float32": "FLOAT", "float64": "DOUBLE"}
    return int(TensorProto.DataType.Value(names.get(type_.dtype, type_.dtype.upper())))
