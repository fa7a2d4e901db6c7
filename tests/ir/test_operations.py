"""The table of operations: each row by an example, as torch, its meta tensors and onnxruntime see it; and its facts."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import pytest
import torch
from torch import Tensor, nn

from tests.ir.meta import assert_types
from tests.ir.operation_examples import EXAMPLES
from tests.lower.modules import ALL, captured
from tests.lower.sessions import run
from tests.passes.graphs import B, Builder
from tests.passes.specs import toy_spec
from ttscompile.capture.export import capture
from ttscompile.errors import CaptureError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.graph import Graph, TensorType
from ttscompile.ir.operations import OPERATIONS, operation
from ttscompile.lower.program import lower_graph

LOWERED = [name for name, row in OPERATIONS.items() if row.onnx]
UNLOWERED = [name for name, row in OPERATIONS.items() if not row.onnx]
CHUNKS = [LOWERED[i : i + 50] for i in range(0, len(LOWERED), 50)]


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


@pytest.mark.parametrize("names", [*CHUNKS, UNLOWERED], ids=lambda names: f"{names[0]} to {names[-1]}")
def test_every_row_is_exercised_and_has_the_types_of_meta_tensors(names: list[str]) -> None:
    graph = _captured(tuple(names))[0]
    assert sorted(set(names) - {operation(node.op).name for node in graph.nodes}) == []
    assert_types(graph, names[0])


@pytest.mark.parametrize("names", CHUNKS[:2], ids=lambda names: f"{names[0]} to {names[-1]}")
def test_a_row_with_an_onnx_form_computes_the_same_in_onnxruntime(names: list[str]) -> None:
    graph, weights, numbers = _captured(tuple(names))
    inputs = values(dict(graph.inputs), 3)
    (expected,) = evaluate(graph, weights, inputs)
    (found,) = run(lower_graph(graph, "examples"), weights, inputs)
    both = zip(names, torch.from_numpy(found).split(numbers, 1), expected.split(numbers, 1), strict=True)
    for name, left, right in both:
        torch.testing.assert_close(left, right, equal_nan=True, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize("name", ALL)
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


def test_a_network_with_an_operation_without_a_row_is_refused_at_capture() -> None:
    class Uncommon(Uses):
        def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
            return sample * torch.special.ndtri(obs[:, :1, :1].sigmoid())

    with pytest.raises(CaptureError, match=r"ndtri.*test_operations.py:\d+ in forward.* has no row"):
        capture(Uncommon([]), toy_spec(sample=(4, 1), obs=(4, 6)))
