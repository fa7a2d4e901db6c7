"""Models of somebody who knows the format: loops without end, operators of others, functions of their own."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto
from onnx.helper import make_function, make_graph, make_node, make_opsetid, make_tensor_value_info

from tests.hostile.forged import forge
from ttscompile.artifact import load_artifact
from ttscompile.errors import ArtifactError


def scalar(name: str, dtype: int) -> onnx.ValueInfoProto:
    return make_tensor_value_info(name, dtype, [])


def endless(model: onnx.ModelProto) -> None:
    """A Loop whose condition is always true, of as many turns as there are numbers, on which the output depends."""
    graph = model.graph
    last = graph.output[0].name
    for node in graph.node:
        for i, output in enumerate(node.output):
            node.output[i] = "before" if output == last else output
    body = make_graph(
        [make_node("Identity", ["go"], ["on"]), make_node("Identity", ["kept"], ["next"])],
        "body",
        [scalar("turn", TensorProto.INT64), scalar("go", TensorProto.BOOL), scalar("kept", TensorProto.FLOAT)],
        [scalar("on", TensorProto.BOOL), scalar("next", TensorProto.FLOAT)],
    )
    graph.node.extend(
        [
            make_node("Constant", [], ["turns"], value=onnx.numpy_helper.from_array(np.array(2**62))),
            make_node("Constant", [], ["true"], value=onnx.numpy_helper.from_array(np.array(True))),
            make_node("Constant", [], ["zero"], value=onnx.numpy_helper.from_array(np.array(0, np.float32))),
            make_node("Loop", ["turns", "true", "zero"], ["made"], body=body),
            make_node("Add", ["before", "made"], [last]),
        ]
    )


def hidden(model: onnx.ModelProto) -> None:
    """The same in a branch of an If."""
    graph = make_graph([], "g", [], [])
    endless_node = make_node("Loop", ["a", "b"], ["c"], body=graph)
    branch = make_graph([endless_node], "branch", [], [])
    model.graph.node.append(make_node("If", ["x"], ["y"], then_branch=branch, else_branch=branch))


def nested(model: onnx.ModelProto) -> None:
    """A Scan within a Scan; one alone is in blocks of eight bits (``tests/runtimes/test_integer_attention.py``)."""
    inner = make_graph([make_node("Scan", ["a"], ["b"], body=make_graph([], "c", [], []))], "d", [], [])
    model.graph.node.append(make_node("Scan", ["x"], ["y"], body=inner))


def of_others(model: onnx.ModelProto) -> None:
    model.graph.node[0].domain = "evil"
    model.opset_import.append(make_opsetid("evil", 1))


def of_onnxruntime(model: onnx.ModelProto) -> None:
    """It has operators that generate texts, and one that reads a file."""
    model.graph.node.append(make_node("EPContext", [], ["z"], domain="com.microsoft", ep_cache_context="/etc/passwd"))


def function(model: onnx.ModelProto) -> None:
    """One that is called twice by the next, and so on, is taken apart into 2^n nodes."""
    model.functions.append(make_function("own", "F", ["x"], ["y"], [make_node("Identity", ["x"], ["y"])], []))


def training(model: onnx.ModelProto) -> None:
    model.training_info.add()


def devices(model: onnx.ModelProto) -> None:
    model.graph.node[0].device_configurations.add()


@pytest.mark.parametrize("change", [endless, hidden, nested, of_others, of_onnxruntime, function, training, devices])
def test_what_convert_never_writes(change: Callable[[onnx.ModelProto], None], written: Path) -> None:
    path = written / "stem.onnx"
    model = onnx.load(path, load_external_data=False)
    change(model)
    path.write_bytes(model.SerializeToString())
    forge(written)
    with pytest.raises(ArtifactError, match=r"stem\.onnx: expected an ONNX model; found .*which convert never writes"):
        load_artifact(written)


def test_a_name_twice_is_no_way_round(written: Path) -> None:
    """Of a field that is there twice the last one counts for some readers, the first for others."""
    path = written / "stem.onnx"
    node = b"\x22\x04Loop\x22\x08Identity"
    path.write_bytes(path.read_bytes() + b"\x3a" + bytes([len(node) + 2]) + b"\x0a" + bytes([len(node)]) + node)
    forge(written)
    with pytest.raises(ArtifactError, match="the operator ':Identity/Loop'"):
        load_artifact(written)
