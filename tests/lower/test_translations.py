"""Operations that are exported in a form of our own: what onnxruntime gives is what torch gives, for every argument."""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch

from tests.rounding import Counted, assert_equal_but_for_rounding
from tests.runtimes.toys import B, f32, node
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Graph, Node, Ref

from .sessions import lower_graph, session

CHANNELS = 6
Call = tuple[str, dict[str, tuple[int, ...]], tuple[Any, ...]]


def lowered(inner: tuple[int, ...], calls: Sequence[Call]) -> set[str]:
    """Lower operations on one tensor of six channels, compare each with torch on three streams, and give ONNX's names.

    Args:
        inner: sizes of the axes behind the channels.
        calls: of each operation its name, the shapes of its weights, and its arguments after the tensor.
    """
    generator = torch.Generator().manual_seed(0)
    kind, x = f32(B, CHANNELS, *inner), torch.randn((3, CHANNELS, *inner), generator=generator)
    values: dict[str, torch.Tensor] = {}
    nodes: list[Node] = []
    for i, (op, shapes, arguments) in enumerate(calls):
        names = {name: f"{name}{i}" for name in shapes}
        values |= {names[name]: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
        given = [Ref(names[a]) if isinstance(a, str) and a in names else a for a in arguments]
        constants = {name: f32(*value.shape) for name, value in values.items()}
        alone = (node("y", op, kind, Ref("x"), *given),)
        made = evaluate(Graph({"x": kind}, constants, alone, ("y",)), values, {"x": x})[0]
        nodes.append(node(f"y{i}", op, f32(B, *made.shape[1:]), Ref("x"), *given))
    outputs = tuple(each.name for each in nodes)
    graph = Graph({"x": kind}, constants, tuple(nodes), outputs)
    with Counted() as counted:
        expected = evaluate(graph, values, {"x": x})
    model = lower_graph(graph, "piece")
    for found, one in zip(session(model, values).run(list(outputs), {"x": x.numpy()}), expected, strict=True):
        assert_equal_but_for_rounding(np.asarray(found), one.numpy(), 2 * counted.terms)
    return {each.op_type for each in model.graph.node}


@pytest.mark.parametrize("inner", [(5,), (4, 7)])
def test_group_norm_is_one_normalisation(inner: tuple[int, ...]) -> None:
    size = (CHANNELS,)
    with_weights: Call = ("group_norm.default", {"w": size, "b": size}, (3, "w", "b", 1e-3, False))
    without_bias: Call = ("group_norm.default", {"w": size}, (2, "w", None, 1e-5, True))
    names = lowered(inner, [with_weights, without_bias, ("group_norm.default", {}, (3,))])
    assert "InstanceNormalization" in names and not names & {"ReduceMean", "GroupNormalization"}


@pytest.mark.slow
@pytest.mark.parametrize("positions", [3, 8, 31])
def test_a_convolution_over_few_positions_is_a_product(positions: int) -> None:
    calls = []
    for (kernel, padding, dilation), stride in product([(1, 0, 1), (3, 1, 1), (5, 2, 1), (3, 2, 2), (2, 1, 1)], [1, 2]):
        shapes, more = {"w": (10, CHANNELS, kernel), "b": (10,)}, ((stride,), (padding,), (dilation,))
        calls += [("conv1d.default", shapes, ("w", bias, *more)) for bias in (None, "b")]
    names = lowered((positions,), calls)
    assert "Conv" not in names and names & {"MatMul", "Gemm"}


@pytest.mark.slow
@pytest.mark.parametrize(("positions", "groups"), [(33, 1), (64, 1), (4, 2)])
def test_one_over_many_positions_or_in_groups_stays(positions: int, groups: int) -> None:
    shapes = {"w": (10, CHANNELS // groups, 3), "b": (10,)}
    assert "Conv" in lowered((positions,), [("conv1d.default", shapes, ("w", "b", (1,), (1,), (1,), groups))])
