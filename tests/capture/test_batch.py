"""Sizes that grow with the batch are multiples of it; what depends on it otherwise is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from tests.passes.specs import toy_spec
from ttscompile.capture.batch import unify_batch
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

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        y = sample.chunk(len(sample), 0)[0] if len(sample) > 5 else sample
        return y.expand(sample.shape) * obs[:, :1, None]


def test_a_module_that_looks_at_the_number_of_streams_is_refused() -> None:
    with pytest.raises(CaptureError):
        capture(Branches(), toy_spec())
