"""``hstack`` and its kind are captured as the ``cat`` that they are, and run where the artifact runs."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from tests.lower.sessions import lower_graph, run
from tests.passes.specs import toy_spec
from ttscompile.capture.export import capture

STACKS = (torch.hstack, torch.vstack, torch.dstack, torch.column_stack)


class Stacks(nn.Module):
    """One of ``STACKS`` on constants of every rank, and on what has streams, unless it would stack these."""

    def __init__(self, stack: Callable[[list[Tensor]], Tensor]) -> None:
        super().__init__()
        self.stack = stack

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        own = [torch.tensor(0.5), torch.arange(3.0), torch.ones(2, 3), torch.ones(2, 3, 2)]
        constants = torch.cat([self.stack([one, one + 1]).reshape(-1) for one in own])
        y = sample + (constants * torch.arange(len(constants))).sum()
        for one in () if self.stack is torch.vstack else (obs, sample):
            row = self.stack([one, 2 * one]).reshape(len(sample), -1)
            y = y + (row * torch.arange(row.shape[1])).sum(1)[:, None, None]
        return y


@pytest.mark.slow
@pytest.mark.parametrize("stack", STACKS, ids=lambda stack: stack.__name__)
def test_it_is_a_cat_and_computes_the_same_in_onnxruntime(stack: Callable[[list[Tensor]], Tensor]) -> None:
    module = Stacks(stack)
    graph, weights = capture(module, toy_spec())
    assert "stack" not in " ".join(node.op for node in graph.nodes)
    inputs = {"sample": torch.randn(2, 4, 2), "timestep": torch.tensor([1, 2]), "obs": torch.randn(2, 3)}
    (found,) = run(lower_graph(graph, "stacks"), {n: torch.from_numpy(w) for n, w in weights.items()}, inputs)
    torch.testing.assert_close(torch.from_numpy(found), module(**inputs))
