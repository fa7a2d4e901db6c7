"""Sizes that grow with the batch are multiples of it; what depends on it otherwise is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from tests.passes.specs import toy_spec
from ttscompile.capture.batch import RARE, unify_batch
from ttscompile.capture.export import capture
from ttscompile.errors import CaptureError
from ttscompile.ir.graph import Batch, Graph, Node, Ref, TensorType


def graph(size: int, argument: object = 1) -> Graph:
    node = Node("y", "aten.slice.Tensor", (Ref("x"), 0, 0, argument), (), (TensorType((size,), "float32"),), "a.py:1")  # type: ignore[arg-type]
    return Graph({"x": TensorType((size,), "float32")}, {}, (node,), ("y",))


def test_sizes_that_grow_with_the_batch_are_multiples_of_it() -> None:
    found = unify_batch(graph(10, 5), graph(14, 7))
    assert found.inputs["x"].shape == (Batch(2),) and found.nodes[0].args[3] == Batch()


def test_boundaries_may_be_counted_from_the_end() -> None:
    assert unify_batch(graph(10, -5), graph(14, -7)).nodes[0].args[3] == Batch(-1)


def test_what_depends_on_the_batch_otherwise_is_refused() -> None:
    with pytest.raises(CaptureError, match=r"%y \(a.py:1\) is 6 for a batch of 5 and 8 for 7"):
        unify_batch(graph(5, 6), graph(7, 8))
    with pytest.raises(CaptureError, match="has the argument True or False"):
        unify_batch(graph(5, True), graph(7, False))
    left, right = (graph(size) for size in (5, 7))
    several = tuple(replace(node, types=node.types * 2) for node in right.nodes)
    with pytest.raises(CaptureError, match="%y .* gives 1 values or 2, by the batch size"):
        unify_batch(left, replace(right, nodes=several))


class Branches(nn.Module):
    """Does something else for many streams."""

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        y = sample.chunk(len(sample), 0)[0] if len(sample) > 5 else sample
        return y.expand(sample.shape) * obs[:, :1, None]


def test_a_module_that_looks_at_the_number_of_streams_is_refused() -> None:
    with pytest.raises(CaptureError):
        capture(Branches(), toy_spec())


class Odd(nn.Module):
    """Has as many hidden numbers as ``RARE``, and twice as many, and computes with what is given."""

    def __init__(self, then: Callable[[Tensor], Tensor] = torch.tanh) -> None:
        super().__init__()
        self.up, self.down, self.then = nn.Linear(2, 2 * RARE), nn.Linear(RARE, 2), then

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        return self.down(self.then(self.up(sample).unflatten(-1, (RARE, 2)).sum(-1)))


@pytest.mark.parametrize(
    "then", [torch.tanh, lambda h: h.clamp(max=3 * RARE), lambda h: h[..., -RARE:], lambda h: torch.fmod(h, RARE)]
)
def test_a_number_of_the_network_may_be_the_batch_size_of_the_capture(then: Callable[[Tensor], Tensor]) -> None:
    found, _ = capture(Odd(then), toy_spec())
    assert {size for node in found.nodes for size in node.type.shape} == {Batch(), 4, 2, RARE, 2 * RARE}
    numbers = {argument for node in found.nodes for argument in node.args if isinstance(argument, int | Batch)}
    assert not any(isinstance(number, Batch) for number in numbers)


def test_a_number_that_changes_no_shape_is_no_batch() -> None:
    class Clamped(nn.Module):
        def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
            return sample.clamp(max=RARE) + 0 * obs[:, :1, None]

    (clamp,) = (node for node in capture(Clamped(), toy_spec())[0].nodes if "clamp" in node.op)
    assert RARE in (*clamp.args, *dict(clamp.kwargs).values())
