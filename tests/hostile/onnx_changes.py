"""Changes of ONNX models: where weights lie, shapes, types, operations; and of their bytes."""

import random

from tests.hostile.mutate import damaged

LOCATIONS = (
    "../outside.bin",
    "/etc/passwd",
    "/dev/zero",
    "../compiled/weights.safetensors",
    "manifest.json",
    "weights.safetensors",
    "folder/weights.safetensors",
    "",
    ".",
    "\x00",
    "a" * 5000,
    "file:///etc/passwd",
    "*/_ORT_MEM_ADDR_/*",
)
SIZES = (
    "0",
    "-1",
    "1",
    "8",
    "9223372036854775807",
    "-9223372036854775808",
    "18446744073709551616",
    "abc",
    "",
    "1e9",
    "4096",
)
OPERATIONS = (
    *("Identity", "Reshape", "Add", "MatMul", "ConstantOfShape", "Loop", "If", "RandomNormal", "Tile", "Gather"),
    *("Scan", "SequenceMap", "NonZero", "Unique", "Resize", "TopK", "Expand", "Pad", "DynamicQuantizeMatMul"),
)
DIMENSIONS = (0, -1, 1, 2, 3, 2**31, 2**40, 2**62, 2**63 - 1)


def changed_model(rng: random.Random, content: bytes) -> bytes:  # noqa: PLR0912  # a branch for each change
    """An ONNX model after one change."""
    import onnx
    from google.protobuf.message import Error

    kind = rng.random()
    if kind < 0.25:
        return damaged(rng, content)
    model = onnx.ModelProto()
    model.ParseFromString(content)
    graph = model.graph
    if kind < 0.5 and graph.initializer:
        _displace(rng, rng.choice(graph.initializer))
    elif kind < 0.6 and graph.initializer:
        tensor = rng.choice(graph.initializer)
        if tensor.dims and rng.random() < 0.6:
            tensor.dims[rng.randrange(len(tensor.dims))] = rng.choice(DIMENSIONS)
        elif rng.random() < 0.5:
            tensor.data_type = rng.choice((0, 1, 2, 7, 8, 9, 16, 23, 99))
        else:
            tensor.raw_data = tensor.raw_data[: rng.randrange(len(tensor.raw_data) + 1)]
    elif kind < 0.8 and graph.node:
        _change_node(rng, graph)
    elif kind < 0.9:
        value = rng.choice([*graph.input, *graph.output])
        shape = value.type.tensor_type.shape
        if shape.dim and rng.random() < 0.7:
            shape.dim[rng.randrange(len(shape.dim))].dim_value = rng.choice(DIMENSIONS)
        else:
            value.type.tensor_type.elem_type = rng.choice((0, 1, 2, 7, 8, 9, 10, 11, 99))
    elif kind < 0.95:
        model.opset_import[0].version = rng.choice((0, 1, 7, 30, 2**31, -1))
        model.ir_version = rng.choice((0, 3, 10, 99))
    else:
        _loop(rng, model)
    try:
        return model.SerializeToString()
    except (Error, ValueError):
        return damaged(rng, content)


def _displace(rng: random.Random, tensor) -> None:  # type: ignore[no-untyped-def]
    """Say that the data of a tensor lies elsewhere."""
    from onnx import TensorProto

    if tensor.data_location != TensorProto.EXTERNAL:
        for field in ("raw_data", "float_data", "int64_data"):
            tensor.ClearField(field)
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="weights.safetensors")
        tensor.external_data.add(key="offset", value="0")
    for entry in tensor.external_data:
        if rng.random() < 0.6:
            entry.value = rng.choice(LOCATIONS if entry.key == "location" else SIZES)
    if rng.random() < 0.3:
        tensor.external_data.add(key=rng.choice(("offset", "length", "location", "x")), value=rng.choice(SIZES))


def _change_node(rng: random.Random, graph) -> None:  # type: ignore[no-untyped-def]
    node = rng.choice(graph.node)
    kind = rng.randrange(6)
    if kind == 0:
        node.op_type = rng.choice(OPERATIONS)
    elif kind == 1:
        node.domain = rng.choice(("com.microsoft", "evil", "ai.onnx.ml"))
    elif kind == 2 and node.attribute:
        attribute = rng.choice(node.attribute)
        attribute.i = rng.choice(DIMENSIONS)
        attribute.ints.extend([rng.choice(DIMENSIONS)])
    elif kind == 3 and node.input:
        node.input[rng.randrange(len(node.input))] = rng.choice([node.output[0], "nothing", "", *node.input])
    elif kind == 4:
        graph.node.remove(node)
    else:
        node.output[0] = rng.choice(("other", "", node.input[0] if node.input else "x"))


def _loop(rng: random.Random, model) -> None:  # type: ignore[no-untyped-def]
    """Work without end or memory without end, hung to the model's first output."""
    from onnx import TensorProto
    from onnx.helper import make_node, make_tensor

    name = model.graph.output[0].name
    size = rng.choice((2**28, 2**33, 2**40, 2**62))
    shape = make_tensor("huge.shape", TensorProto.INT64, [1], [size])
    nodes = [
        make_node("Constant", [], ["huge.shape"], value=shape),
        make_node("ConstantOfShape", ["huge.shape"], ["huge"]),
        make_node("ReduceSum", ["huge"], ["huge.sum"], keepdims=0),
        make_node("Add", [f"{name}.before", "huge.sum"], [name]),
    ]
    for node in model.graph.node:
        for i, output in enumerate(node.output):
            if output == name:
                node.output[i] = f"{name}.before"
    model.graph.node.extend(nodes)
