"""The table of operations: each row by an example, as torch, its meta tensors and onnxruntime see it; and its facts."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn.utils import parametrizations, parametrize

from tests.ir.meta import assert_types
from tests.ir.operation_examples import EXAMPLES
from tests.lower.modules import ALL, captured
from tests.lower.sessions import lower_graph, run
from tests.passes.graphs import B, Builder
from tests.passes.specs import toy_spec
from tests.quick import first_quick
from tests.rounding import bound
from ttscompile.capture.export import capture
from ttscompile.errors import CaptureError, LoweringError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.graph import Graph, Node, TensorType
from ttscompile.ir.operations import OPERATIONS, Linear, Movement, axes_along, axis_after, operation, permutation
from ttscompile.lower.promotion import may_promote


def of(name: str | Node) -> Callable[[str], str]:
    """What is wrong, and with which operation."""
    return lambda message: f"{name}: {message}"


UNLOWERED = """
    cumprod searchsorted hypot copysign fmax fmin lgamma digamma erfinv i0 special_i0
    isin cdist cummax cummin median nanmedian kthvalue linalg_eigh linalg_inv linalg_solve linalg_qr linalg_cholesky
    matrix_exp
""".split()
"""What torch's exporter has no ONNX form for: it can stand only in what is computed at compile time."""

PROMOTED = """
    float_power arange any all argsort bucketize index_put index_add index_fill scatter scatter_add count_nonzero
""".split()
"""In whose examples types may be promoted: torch's exporter looks through them once more (``lower.promotion``)."""

LOWERED = [name for name in OPERATIONS if name not in (*UNLOWERED, *PROMOTED)]
CHUNKS = [*(LOWERED[i : i + 50] for i in range(0, len(LOWERED), 50)), PROMOTED]


class Uses(nn.Module):
    """The results of examples on the observation, in a row."""

    def __init__(self, names: Iterable[str]) -> None:
        super().__init__()
        self.names = tuple(names)

    def results(self, obs: Tensor) -> list[Tensor]:
        """Float32 ``[B, numbers]``, one an example."""
        x = obs.sigmoid() * 0.8 + 0.1
        i = (x * 3).long()
        found = [EXAMPLES[name](x, i) for name in self.names]
        return [(r if isinstance(r, Tensor) else r[0]).reshape(x.shape[0], -1).float() for r in found]

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        return torch.cat(self.results(obs), 1)[:, :, None]


@cache
def _captured(names: tuple[str, ...]) -> tuple[Graph, dict[str, Tensor], list[int]]:
    """The graph of examples, its weights, and how many numbers each of them gives."""
    module = Uses(names)
    numbers = [row.shape[1] for row in module.results(torch.zeros(1, 4, 6))]
    graph, weights = capture(module, toy_spec(sample=(sum(numbers), 1), obs=(4, 6)))
    return graph, {name: torch.from_numpy(value) for name, value in weights.items()}, numbers


def values(types: dict[str, TensorType], streams: int = 2, seed: int = 0) -> dict[str, Tensor]:
    """Floats between 0.1 and 0.9, integers of 0, 1 and 2, booleans."""
    draw = torch.Generator().manual_seed(seed)
    found = {}
    for name, type_ in types.items():
        dtype, shape = getattr(torch, type_.dtype), type_.at(streams)
        random = torch.rand(shape, generator=draw, dtype=torch.float64)
        if dtype == torch.bool:
            found[name] = random > 0.5
        else:
            found[name] = (random * 0.8 + 0.1 if dtype.is_floating_point else random * 3).to(dtype)
    return found


def test_every_row_has_an_example_and_every_example_a_row() -> None:
    assert EXAMPLES.keys() == OPERATIONS.keys()
    assert [name for name, row in OPERATIONS.items() if row.name != name] == []


@pytest.mark.parametrize("names", first_quick([*CHUNKS, UNLOWERED]), ids=lambda names: f"{names[0]} to {names[-1]}")
def test_every_row_is_exercised_and_has_the_types_of_meta_tensors(names: list[str]) -> None:
    graph = _captured(tuple(names))[0]
    assert sorted(set(names) - {operation(node.op).name for node in graph.nodes}) == []
    assert_types(graph, names[0])


@pytest.mark.parametrize("names", first_quick(CHUNKS), ids=lambda names: f"{names[0]} to {names[-1]}")
def test_a_row_with_an_onnx_form_computes_the_same_in_onnxruntime(names: list[str]) -> None:
    graph, weights, numbers = _captured(tuple(names))
    assert may_promote(graph) == (names == PROMOTED)
    inputs = values(dict(graph.inputs), 3)
    (expected,) = evaluate(graph, weights, inputs)
    (found,) = run(lower_graph(graph, "examples"), weights, inputs)
    both = zip(names, torch.from_numpy(found).split(numbers, 1), expected.split(numbers, 1), strict=True)
    for name, left, right in both:
        wide: dict[str, Any] = {"rtol": 0.0, "atol": _cancelled(inputs["obs"], right)} if name == "group_norm" else {}
        torch.testing.assert_close(left, right, equal_nan=True, msg=of(name), **wide)


def _cancelled(obs: Tensor, normalised: Tensor) -> float:
    """Rounding of a variance that is taken as mean of squares less square of mean, as onnxruntime's normalisation does.

    The sums of a group of 12 numbers are off by their rounding, which is so much more of the small difference.
    """
    groups = (obs.sigmoid() * 0.8 + 0.1).double().reshape(-1, 12)
    lost = groups.square().mean(1) / groups.var(1, correction=0)
    return bound(12) * float(lost.max() * normalised.abs().max())


@pytest.mark.parametrize("name", first_quick(UNLOWERED))
def test_a_row_without_an_onnx_form_is_refused(name: str) -> None:
    with pytest.raises(LoweringError, match=r"piece 'examples' could not be exported .*Its operations are .*aten\."):
        lower_graph(_captured((name,))[0], "examples")


@pytest.mark.parametrize("name", first_quick(ALL))
def test_networks_have_the_types_of_meta_tensors(name: str) -> None:
    assert_types(captured(name)[1], name)


def test_a_wrong_type_is_found() -> None:
    b = Builder()
    graph = b.graph(b.op("y", "exp.default", (B, 3), b.input("x", B, 4)))
    with pytest.raises(AssertionError, match=r"toy: %y : float32\[B, 3\]"):
        assert_types(graph, "toy")


@pytest.mark.parametrize("op", ["aten.fft_rfft.default", "aten.as_strided.default", "aten.view.default"])
def test_an_operation_without_a_row_is_refused(op: str) -> None:
    b = Builder()
    graph = b.graph(b.op("y", op.removeprefix("aten."), (B, 3), b.input("x", B, 4)))
    with pytest.raises(CaptureError, match=f"{op}' of node %y .*toy.py:0.* has no row in the table of operations"):
        evaluate(graph, {}, {"x": torch.ones(2, 4)})
    with pytest.raises(CaptureError, match="has no row"):
        graph_flops(graph)


@pytest.mark.slow
def test_a_network_with_an_operation_without_a_row_is_refused_at_capture() -> None:
    class Uncommon(Uses):
        def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
            return sample * torch.special.ndtri(obs[:, :1, :1].sigmoid())

    with pytest.raises(CaptureError, match=r"ndtri.*test_operations.py:\d+ in forward.* has no row"):
        capture(Uncommon([]), toy_spec(sample=(4, 1), obs=(4, 6)))


@pytest.mark.slow
def test_an_operation_that_makes_a_weight_is_refused_with_the_remedy() -> None:
    class Narrow(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.leave = parametrizations.orthogonal(nn.Linear(6, 1))

        def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
            return sample + timestep[:, None, None] * self.leave(obs)

    network, spec = Narrow(), toy_spec(sample=(4, 1), obs=(4, 6))
    with pytest.raises(CaptureError, match=r"householder.*where it makes a weight, call torch.nn.*remove_param"):
        capture(network, spec)
    parametrize.remove_parametrizations(network.leave, "weight")
    assert len(capture(network, spec)[1]) >= 2


def _nodes(has: str) -> list[tuple[Graph, Node]]:
    """Nodes of the examples whose row has this fact, each as a graph of its own that reads nothing but inputs."""
    found: dict[str, tuple[Graph, Node]] = {}
    for names in [*CHUNKS, UNLOWERED]:
        whole = _captured(tuple(names))[0]
        types = whole.types()
        for node in whole.nodes:
            row = operation(node.op)
            if getattr(row, has) and list(node.refs()):
                graph = Graph({name: types[name] for name in node.refs()}, {}, (node,), (node.name,))
                found.setdefault(f"{row.name} {node.op}", (graph, node))
    assert {node.op for _, node in found.values()}
    return list(found.values())


def _first(graph: Graph, inputs: dict[str, Tensor]) -> Tensor:
    """The value of the one node, or the first of several."""
    (value,) = evaluate(graph, {}, inputs)
    return value if isinstance(value, Tensor) else value[0]


@pytest.mark.slow
def test_elementwise_is_elementwise() -> None:
    """Numbers that change places together give results that change places."""
    for graph, node in _nodes("elementwise"):
        inputs = values(dict(graph.inputs))
        shape = torch.broadcast_shapes(*(value.shape for value in inputs.values()))
        assert shape == node.type.at(2), node
        wide = {name: value.expand(shape) for name, value in inputs.items()}
        order = torch.randperm(math.prod(shape), generator=torch.Generator().manual_seed(0))
        types = {name: TensorType(shape, type_.dtype) for name, type_ in graph.inputs.items()}
        bare = replace(graph, inputs=types)
        moved = {name: value.flatten()[order].view(shape) for name, value in wide.items()}
        expected = _first(bare, wide).flatten()[order].view(shape)
        torch.testing.assert_close(_first(bare, moved), expected, equal_nan=True, msg=of(node))


@pytest.mark.slow
def test_linear_is_linear() -> None:
    """What is affine gives for a sum of inputs, less one, the sum of what it gives, less one."""
    for graph, node in _nodes("linear"):
        row, names = operation(node.op), list(graph.inputs)
        if len(names) < len(list(node.refs())) or not node.type.dtype.startswith("float"):
            continue  # of a value and itself, or of integers
        moving = {Linear.JOINTLY: [names], Linear.IN_FIRST: [names[:1]], Linear.IN_EACH: [[name] for name in names]}
        for together in moving[row.linear]:  # type: ignore[index]
            left, right, zero = (values(dict(graph.inputs), seed=seed) for seed in (1, 2, 3))
            for other in (right, zero):
                other |= {name: value for name, value in left.items() if name not in together}
            total = {name: left[name] + right[name] - zero[name] if name in together else left[name] for name in names}
            expected = _first(graph, left) + _first(graph, right) - _first(graph, zero)
            torch.testing.assert_close(_first(graph, total), expected, msg=of(node))


@pytest.mark.slow
def test_movements_move() -> None:
    for graph, node in _nodes("movement"):
        ((name, type_),) = list(graph.inputs.items())[:1]
        inputs = values(dict(graph.inputs))
        x, y, rank = inputs[name], _first(graph, inputs), len(type_.shape)
        match operation(node.op).movement:
            case Movement.RESHAPE:
                assert torch.equal(x.flatten(), y.flatten()), node
            case Movement.PERMUTE:
                assert torch.equal(x.permute(permutation(node, rank)), y), node
            case Movement.PART | Movement.REPEAT as movement:
                assert set(y.flatten().tolist()) <= set(x.flatten().tolist()), node
                assert movement is Movement.REPEAT or y.numel() <= x.numel(), node


@pytest.mark.slow
@pytest.mark.parametrize("fact", ["along", "mixes"])
def test_what_lies_across_is_treated_alike(fact: str) -> None:
    """To turn around an axis that an operation does not work along is to turn around its result."""
    for graph, node in _nodes(fact):
        name, inputs = next(iter(graph.inputs)), values(dict(graph.inputs))
        rank, y = inputs[name].dim(), _first(graph, inputs)
        mixes = operation(node.op).mixes
        mixed = axes_along(node, rank) if mixes is None else range(rank - (mixes(node, graph.types()) or rank), rank)
        for axis in set(range(rank)) - set(mixed):
            after = axis_after(node, axis, graph.types())
            assert after is not None, node
            turned = _first(graph, {**inputs, name: inputs[name].flip(axis)})
            torch.testing.assert_close(turned, y.flip(after), msg=of(node))


@pytest.mark.slow
def test_filled_is_filled() -> None:
    for graph, node in _nodes("filled"):
        row = operation(node.op)
        assert row.filled is not None
        value = row.filled(node)
        if isinstance(value, int | float):
            assert torch.equal(_first(graph, values(dict(graph.inputs))), torch.full(node.type.at(2), float(value)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "flops"),
    [
        ("linear", 2 * 4 * 3 * 6), ("matmul", 2 * 4 * 4 * 6), ("mm", 2 * 6 * 2), ("mv", 2 * 6),
        ("addmm", 2 * 6 * 2), ("baddbmm", 2 * 4 * 4 * 6), ("bilinear", 2 * 4 * 2 * 6 * 6),
        ("einsum", 2 * 4 * 4 * 6), ("tensordot", 2 * 4 * 6 * 2), ("scaled_dot_product_attention", 2 * 2 * 4 * 4 * 6),
        ("conv1d", 2 * 2 * 4 * 4 * 3), ("conv2d", 2 * 2 * 24 * 9), ("conv_transpose1d", 2 * (4 * 6) * (2 * 3)),
        ("gru.input", 2 * 4 * 15 * (6 + 5)), ("gelu", 0), ("softmax", 0), ("dot", 2 * 3),
    ],
)  # fmt: skip
def test_flops_are_those_of_a_hand(name: str, flops: int) -> None:
    counts = set()
    for names in CHUNKS:
        whole = _captured(tuple(names))[0]
        for node in whole.nodes:
            if name in names and operation(node.op).name == name:
                counts.add(graph_flops(Graph(whole.types(), {}, (node,), (node.name,))))
    assert flops in counts
