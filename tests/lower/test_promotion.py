"""Where types are promoted is written out or left to torch's exporter; where none is, the exporter looks for none."""

import numpy as np
import onnx
import pytest
import torch

from tests.lower.sessions import lower_graph, run
from ttscompile.ir.graph import Graph, Node, Ref, TensorType
from ttscompile.lower.promotion import may_promote


def graph_of(op: str, dtype: str, made: str, *more: object) -> Graph:
    """One operation on ``x [2, 3]``."""
    node = Node("y", op, (Ref("x"), *more), (), (TensorType((2, 3), made),))  # type: ignore[arg-type]
    return Graph({"x": TensorType((2, 3), dtype)}, {}, (node,), ("y",))


PLAIN = (
    ("aten.add.Tensor", "float32", "float32", 1),
    ("aten.mul.Tensor", "float32", "float32", 0.5),
    ("aten.add.Tensor", "float64", "float64", 1e-12),
    ("aten.gt.Scalar", "float32", "bool", 0),
    ("aten.eq.Scalar", "int64", "bool", 3),
    ("aten.cumsum.default", "bool", "int64", 1),
    ("aten.where.ScalarSelf", "bool", "bool", False, Ref("x")),
)
PROMOTED = (
    ("aten.mul.Tensor", "int64", "float32", 0.5),
    ("aten.div.Tensor", "int64", "float32", 2),
    ("aten.gt.Scalar", "int64", "bool", 0.5),
    ("aten.add.Tensor", "bool", "int64", 1),
)


@pytest.mark.parametrize("case", PLAIN, ids=lambda case: f"{case[0]} {case[1]}")
def test_types_that_are_as_given_are_not_looked_for(case: tuple[str, ...]) -> None:
    assert not may_promote(graph_of(*case))


@pytest.mark.parametrize("case", PROMOTED, ids=lambda case: f"{case[0]} {case[1]}")
def test_other_types_are_left_to_the_exporter(case: tuple[str, ...]) -> None:
    assert may_promote(graph_of(*case))


@pytest.mark.parametrize("case", [*PLAIN[:6], *PROMOTED], ids=lambda case: f"{case[0]} {case[1]}")
def test_either_way_the_model_computes_what_torch_does(case: tuple[str, ...]) -> None:
    op, dtype, _, *more = case
    x = torch.from_numpy(np.array([[0, 1, 3], [1, 0, 7]]).astype(dtype))
    (found,) = run(lower_graph(graph_of(*case), "one"), {}, {"x": x})
    name, _, overload = op.removeprefix("aten.").partition(".")
    expected = getattr(getattr(torch.ops.aten, name), overload)(x, *more).numpy()
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == expected.dtype


def test_a_number_beside_floating_point_ones_is_one_in_the_model() -> None:
    model = lower_graph(graph_of("aten.add.Tensor", "float32", "float32", 1), "one")
    kinds = {each.data_type for each in model.graph.initializer} | {
        attribute.t.data_type for node in model.graph.node for attribute in node.attribute if attribute.HasField("t")
    }
    assert kinds == {onnx.TensorProto.FLOAT}
    assert "Cast" not in {node.op_type for node in model.graph.node}
