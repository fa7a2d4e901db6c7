"""What the graphs of a run are known by."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from tests.passes.specs import toy_spec
from ttscompile.capture.export import capture

from .capturer import captured_once, structure


class Scaled(nn.Module):
    """A layer, a number and a constant that is no buffer."""

    def __init__(self, factor: float = 2.0, constant: float = 1.0, width: int = 2) -> None:
        super().__init__()
        self.layer, self.factor, self.constant = nn.Linear(2, width), factor, torch.full((width,), constant)
        self.function: Callable[[Tensor], Tensor] = torch.tanh

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        return self.function(self.layer(sample) * self.factor + self.constant)[..., :2]


def key(module: nn.Module) -> str | None:
    return structure(module, toy_spec(), 3)


def test_all_but_the_values_of_weights_counts() -> None:
    one = Scaled()
    assert key(one) is not None and key(one) == key(Scaled())
    assert len({key(each) for each in (one, Scaled(3.0), Scaled(constant=3.0), Scaled(width=3))}) == 4
    other = Scaled()
    other.function = torch.sin
    assert key(other) not in (None, key(one))
    assert structure(one, toy_spec(obs=(9,)), 3) != key(one) != structure(one, toy_spec(), 4)


def test_what_has_no_name_is_not_known() -> None:
    one = Scaled()
    one.function = lambda x: x + 1
    assert key(one) is None


def test_a_graph_that_is_there_has_the_weights_of_its_module(tmp_path: Path) -> None:
    with captured_once(tmp_path):
        graph, weights = capture(Scaled(), toy_spec())
        module = Scaled()
        again, own = capture(module, toy_spec())
        assert len(list(tmp_path.iterdir())) == 1
    assert again == graph and list(own) == list(weights)
    assert np.shares_memory(own["layer.weight"], module.layer.weight.detach().numpy())
    assert not np.array_equal(own["layer.weight"], weights["layer.weight"])
    assert any(np.array_equal(value, [1, 1]) for value in own.values()), "the constant"
