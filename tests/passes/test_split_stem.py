"""Of a linear layer of the sample and what is known before the loop, the loop keeps the columns of the sample alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.capture.export import capture
from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.driver import transform
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.program import Captured
from ttscompile.passes.clean_up import CleanUp
from ttscompile.passes.split_tokens import SplitStem
from ttscompile.samplers.flow import flow_matching_table

WIDTH, HORIZON = 8, 5


class Timed(nn.Module):
    """Actions and their time go through one layer together, as in pi0; ``kind`` says what else does."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind, width = kind, {"three": 2 * WIDTH + 6}.get(kind, 2 * WIDTH)
        self.enter, self.mix, self.out = nn.Linear(4, WIDTH), nn.Linear(width, WIDTH), nn.Linear(WIDTH, 4)
        self.blocks = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(2))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        x = self.enter(sample)
        time = (timestep[:, None] * torch.arange(1, WIDTH + 1)).sin()[:, None].expand_as(x)
        seen = obs[:, None].expand(-1, HORIZON, -1)
        parts = {"three": [seen, x, time], "sample": [x, time * x], "tokens": [x, time]}.get(self.kind, [time, x])
        if self.kind == "tokens":
            mixed = self.mix(torch.cat([torch.cat(parts, 1)] * 2, -1))[:, :HORIZON]
        elif self.kind == "computed":
            mixed = nn.functional.linear(torch.cat(parts, -1), self.mix.weight * 2, self.mix.bias)
        else:
            mixed = self.mix(torch.cat(parts, -1))
        x = torch.tanh(mixed)
        for block in self.blocks:
            x = x + torch.tanh(block(x))
        return self.out(x)


def captured(kind: str) -> tuple[nn.Module, Captured]:
    torch.manual_seed(0)
    module = Timed(kind)
    spec = PolicySpec(
        (HORIZON, 4), {"obs": ObservationSpec((6,), window=False)}, flow_matching_table(3), ChunkSpec(4, 0, 5)
    )
    graph, weights = capture(module, spec)
    return module, Captured(spec, graph, weights, dense_flops=10**6)


@pytest.mark.parametrize(("kind", "parts"), [("two", 2), ("three", 3)])
def test_the_columns_of_the_sample_alone_stay_in_the_loop(kind: str, parts: int) -> None:
    module, before = captured(kind)
    result = SplitStem()(before)
    assert result.notes[0].endswith(f"one of {parts} parts is in the loop")
    assert "mix.weight" not in CleanUp[Captured]()(result.program).program.weights
    inputs = {"sample": torch.randn(2, HORIZON, 4), "timestep": torch.rand(2), "obs": torch.randn(2, 6)}
    values = list[Tensor]()
    for program in (before, result.program):
        weights = {name: torch.from_numpy(np.array(value)) for name, value in program.weights.items()}
        with Counted() as counted:
            values += evaluate(program.denoiser, weights, inputs)
    one, other = values
    assert_equal_but_for_rounding(one, other, counted.terms)
    assert SplitStem()(result.program).program is result.program

    pieces = transform(module, before.spec).pieces
    stem = pieces.loop["stem"].graph
    shapes = {name: type_.shape for name, type_ in stem.constants.items()}
    assert (WIDTH, WIDTH) in shapes.values(), "the columns that the sample meets"
    assert all(size[-1:] != (parts * WIDTH,) for size in shapes.values())
    (table,) = pieces.tables.values()
    assert table.shape == (3, 1, 1, WIDTH), "the time's part has one row a step, not one an action"


@pytest.mark.parametrize("kind", ["sample", "tokens", "computed"])
def test_near_misses_are_left_whole(kind: str) -> None:
    """Two parts of the sample; parts beside each other along the tokens; a weight that is computed."""
    _, before = captured(kind)
    assert SplitStem()(before).program is before


def test_a_weight_that_others_read_is_kept() -> None:
    _, before = captured("two")
    last = before.denoiser.nodes[-1]
    outputs = (*before.denoiser.outputs, "mix.weight")
    shared = replace(before, denoiser=replace(before.denoiser, outputs=outputs))
    assert last.name in outputs
    assert "mix.weight" in CleanUp[Captured]()(SplitStem()(shared).program).program.weights
