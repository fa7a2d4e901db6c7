"""From what torch's exporter writes to the ONNX model of a piece: our names, weights without data, nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import count

import onnx
from onnx import AttributeProto, GraphProto, ModelProto, NodeProto, TensorProto, ValueInfoProto, helper

from ..errors import LoweringError
from ..ir.graph import Batch, TensorType

Values = Sequence[tuple[str, TensorType]]

_HEADS_FORWARD = [0, 2, 1, 3]

# New values are called after old ones, with blanks, which the exporter's names have not.
_MERGED = "heads merged"

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
    part = ModelProto()
    part.CopyFrom(model)
    nodes = live_nodes(list(model.graph.node), {value.name for value in outputs})
    own = {value.name for value in inputs}
    foreign = {value.name for value in model.graph.input} - own
    for node in nodes:
        if crossed := foreign.intersection(node.input):
            raise LoweringError(f"{node.op_type} {node.name!r} reads {sorted(crossed)}, the input of another piece.")
    for field, kept in (("node", nodes), ("input", inputs), ("output", outputs)):
        part.graph.ClearField(field)
        getattr(part.graph, field).extend(kept)
    return part


def live_nodes(nodes: Sequence[NodeProto], outputs: set[str]) -> list[NodeProto]:
    """The nodes that outputs depend on."""
    needed = set(outputs)
    live = []
    for node in reversed(nodes):
        if needed.intersection(node.output):
            live.append(node)
            needed.update(node.input)
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


def flatten_attention(model: ModelProto) -> ModelProto:
    """A copy of a model with attention on ``[batch, tokens, heads * channels]``, its heads where they are.

    The exporter transposes heads forward and back. Before, on tensors of four axes::

        q -> Transpose -+
        k -> Transpose -+-> Attention -> Transpose -> y
        v -> Transpose -+

    After, on three, with the number of heads as an attribute::

        q -> Reshape -+
        k -> Reshape -+-> Attention -> Reshape -> y
        v -> Reshape -+

    Measured with onnxruntime 1.31, 1 thread, self-attention of width 256, 16 tokens, 4 heads: 0.129 ms before, 0.118
    after. It is done wherever query, key, value and result are all transposed.
    The transpositions are left behind if something else reads them; ``lower_onnx`` drops what nothing reads.

    Args:
        model: its inner values have shapes (``value_info``); attention whose number of heads is unknown is left alone.
    """
    result = ModelProto()
    result.CopyFrom(model)
    graph = result.graph
    shapes = {  # with zero for a size that depends on the batch
        value.name: tuple(d.dim_value for d in value.type.tensor_type.shape.dim)
        for value in [*graph.value_info, *graph.input, *graph.output]
    }
    makers = {value: node for node in graph.node for value in node.output}
    nodes: list[NodeProto] = []
    constants: dict[str, list[int]] = {}
    replaced: set[str] = set()
    for node in graph.node:
        heads = _heads(node, shapes)
        after = _only_transposition(graph, node)
        befores = [makers.get(value) for value in node.input[:3]]
        sources = [before.input[0] for before in befores if before is not None and _moves_heads(before)]
        if heads is None or after is None or len(sources) < 3:
            nodes.append(node)
            continue
        value = after.output[0]
        nodes += _flat(node, sources, value, heads)
        replaced.add(value)
        constants |= {_MERGED: [0, 0, -1], f"{value} heads": [0, 0, heads[0], -1]}
    del graph.node[:]
    graph.node.extend(n for n in nodes if n.op_type != "Transpose" or n.output[0] not in replaced)
    graph.initializer.extend(
        helper.make_tensor(name, TensorProto.INT64, [len(shape)], shape) for name, shape in constants.items()
    )
    return result


def _flat(node: NodeProto, sources: Sequence[str], result: str, heads: tuple[int, int]) -> list[NodeProto]:
    """The nodes that compute ``result`` from the values before their transpositions."""
    merged = [f"{source} merged for {node.output[0]} {i}" for i, source in enumerate(sources)]
    flat = NodeProto()
    flat.CopyFrom(node)
    del flat.input[:], flat.output[:]
    flat.input.extend([*merged, *node.input[3:]])
    flat.output.append(f"{node.output[0]} merged")
    flat.attribute.append(helper.make_attribute("q_num_heads", heads[0]))
    flat.attribute.append(helper.make_attribute("kv_num_heads", heads[1]))
    before = [helper.make_node("Reshape", [s, _MERGED], [m]) for s, m in zip(sources, merged, strict=True)]
    return [*before, flat, helper.make_node("Reshape", [flat.output[0], f"{result} heads"], [result])]


def _only_transposition(graph: GraphProto, node: NodeProto) -> NodeProto | None:
    """The transposition of the heads that alone reads a node of one result; None if it is otherwise."""
    readers = [reader for reader in graph.node if node.output[0] in reader.input]
    seen = {value.name for value in graph.output}
    alone = len(node.output) == 1 and len(readers) == 1 and node.output[0] not in seen
    return readers[0] if alone and _moves_heads(readers[0]) else None


def _moves_heads(node: NodeProto) -> bool:
    return node.op_type == "Transpose" and any(
        list(a.ints) == _HEADS_FORWARD for a in node.attribute if a.name == "perm"
    )


def _heads(node: NodeProto, shapes: Mapping[str, Sequence[int]]) -> tuple[int, int] | None:
    """Heads of query and of key of an attention, from ``[batch, heads, tokens, channels]``; None if not known."""
    if node.op_type != "Attention":
        return None
    query, key = (shapes.get(value, ()) for value in node.input[:2])
    return (query[1], key[1]) if len(query) == len(key) == 4 and query[1] > 0 and key[1] > 0 else None
