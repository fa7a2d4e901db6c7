"""Sizes that grow with the batch are multiples of it; what depends on it otherwise is refused."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from tests.passes.specs import toy_spec
from ttscompile.capture.batch import BATCHES, with_batch
from ttscompile.capture.export import capture
from ttscompile.errors import CaptureError
from ttscompile.ir.graph import Batch, Graph, Node, Ref, TensorType

FIRST = BATCHES[0]


def graph(size: int, end: int, op: str = "aten.slice.Tensor") -> Graph:
    x, cut = (TensorType((count, 2), "float32") for count in (FIRST, size))
    node = Node("y", op, (Ref("x"), 0, 0, end), (), (cut,), "a.py:1")
    return Graph({"x": x}, {}, (node,), ("y",))


def test_sizes_that_grow_with_the_batch_are_multiples_of_it() -> None:
    found = with_batch(graph(FIRST, FIRST), FIRST)
    assert found.inputs["x"].shape == (Batch(), 2)
    assert found.nodes[0].args[3] == Batch()


def test_boundaries_may_be_counted_from_the_end() -> None:
    b = Node("both", "aten.cat.default", ((Ref("x"), Ref("x")), 0), (), (TensorType((2 * FIRST, 2), "float32"),))
    y = Node("y", "aten.slice.Tensor", (Ref("both"), 0, -FIRST), (), (TensorType((FIRST, 2), "float32"),))
    found = with_batch(Graph({"x": TensorType((FIRST, 2), "float32")}, {}, (b, y), ("y",)), FIRST)
    assert found.nodes[1].args[2] == Batch(-1)


def test_what_depends_on_the_batch_otherwise_is_refused() -> None:
    wrong = (
        rf"size at %y \(a.py:1\) is not a multiple .* shape \({FIRST - 1}, 2\) for {FIRST} streams and \(2, 2\) for 2"
    )
    with pytest.raises(CaptureError, match=wrong):
        with_batch(graph(FIRST - 1, FIRST - 1), FIRST)


class Branches(nn.Module):
    """Does something else for many streams."""

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        y = sample.chunk(len(sample), 0)[0] if len(sample) > 5 else sample
        return y.expand(sample.shape) * obs[:, :1, None]


def test_a_module_that_looks_at_the_number_of_streams_is_refused() -> None:
    with pytest.raises(CaptureError):
        capture(Branches(), toy_spec())


class Odd(nn.Module):
    """Has as many hidden numbers as the first batch size, and twice as many, and computes with what is given."""

    def __init__(self, then: Callable[[Tensor], Tensor] = torch.tanh) -> None:
        super().__init__()
        self.up, self.down, self.then = nn.Linear(2, 2 * FIRST), nn.Linear(FIRST, 2), then

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        return self.down(self.then(self.up(sample).unflatten(-1, (FIRST, 2)).sum(-1)))


@pytest.mark.parametrize(
    "then", [torch.tanh, lambda h: h.clamp(max=3 * FIRST), lambda h: h[..., -FIRST:], lambda h: torch.fmod(h, FIRST)]
)
def test_a_number_of_the_network_may_be_the_batch_size_of_the_capture(then: Callable[[Tensor], Tensor]) -> None:
    found, _ = capture(Odd(then), toy_spec())
    assert {size for node in found.nodes for size in node.type.shape} == {Batch(), 4, 2, FIRST, 2 * FIRST}
    numbers = {argument for node in found.nodes for argument in node.args if isinstance(argument, int | Batch)}
    assert not any(isinstance(number, Batch) for number in numbers)


def test_a_number_that_changes_no_shape_is_no_batch() -> None:
    class Clamped(nn.Module):
        def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
            return sample.clamp(max=FIRST) + 0 * obs[:, :1, None]

    (clamp,) = (node for node in capture(Clamped(), toy_spec())[0].nodes if "clamp" in node.op)
    assert FIRST in (*clamp.args, *dict(clamp.kwargs).values())


def test_one_part_of_a_tensor_is_the_tensor() -> None:
    class Chunk(nn.Module):
        def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
            (whole,), (seen,) = sample.chunk(1, -1), obs.split([obs.shape[1]], 1)
            return whole + 0 * seen[:, None, :1].unbind(2)[0][..., None]

    found, _ = capture(Chunk(), toy_spec())
    assert not any("split" in node.op for node in found.nodes)
