"""Programs that are legal and unusual, made by hand, through the passes that meet them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from tests.passes.graphs import B, Builder
from tests.passes.specs import toy_spec
from tests.passes.test_pipeline import STREAMS, evaluate_pieces
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import ObservationSpec
from ttscompile.driver import transform
from ttscompile.errors import PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Ref
from ttscompile.ir.program import Program
from ttscompile.passes.find_residual_blocks import find_residual_blocks
from ttscompile.passes.hoist import Hoist
from ttscompile.passes.insert_pruner import InsertPruner
from ttscompile.passes.partition import Partition
from ttscompile.verification.record_golden import record_original

SHAPE = (B, 4, 2)


def hoisted(builder: Builder, result: Ref, observation: ObservationSpec) -> Program:
    """The program of a graph of ``sample``, ``timestep`` and ``obs``, up to hoist."""
    graph = builder.graph(result)
    weights = {name: torch.randn(type_.at(1)).numpy() for name, type_ in graph.constants.items()}
    spec = replace(toy_spec(), observations={"obs": observation})
    program = Program(spec, graph, weights, find_residual_blocks(graph, "sample").blocks)
    return Hoist()(Partition()(program).program).program


def inputs(dtype: str) -> tuple[Builder, Ref, Ref]:
    """A builder, the sample and the observation."""
    b = Builder()
    sample = b.input("sample", *SHAPE)
    b.input("timestep", B, dtype="int64")
    return b, sample, b.input("obs", B, 3, dtype=dtype)


def test_a_network_without_products_is_hoisted() -> None:
    b, sample, obs = inputs("float32")
    gate = b.op("gate", "mean.dim", (B, 1, 1), b.op("row", "unsqueeze.default", (B, 1, 3), obs, 1), (2,), True)
    residual = b.op("f", "tanh.default", SHAPE, b.op("g", "mul.Tensor", SHAPE, sample, gate))
    program = hoisted(b, b.op("y", "add.Tensor", SHAPE, sample, residual), ObservationSpec((3,)))
    assert [block.flops for block in program.blocks] == [0]


def labelled() -> Program:
    """Labels that go through an embedding: no arithmetic has made anything that the pruner could read."""
    b, sample, obs = inputs("int64")
    rows = b.op("e", "embedding.default", (B, 3, 2), b.constant("w", 9, 2), obs)
    gate = b.op("gate", "mean.dim", (B, 1, 2), rows, (1,), True)
    linear = b.op("f", "linear.default", SHAPE, sample, b.constant("v", 2, 2))
    total = b.op("y", "add.Tensor", SHAPE, sample, b.op("g", "mul.Tensor", SHAPE, linear, gate))
    return hoisted(b, total, ObservationSpec((3,), dtype="int64", window=False, bounds=(0, 8)))


def test_pruner_reads_whole_numbers_as_floats() -> None:
    program = InsertPruner()(labelled()).program
    pieces = program.pieces
    assert pieces is not None and pieces.pruner is not None and pieces.features == ("obs.feature",)
    weights = {name: torch.from_numpy(value) for name, value in program.weights.items()}
    values = evaluate(pieces.condition, weights, {"obs": torch.tensor([[0, 4, 8], [1, 2, 3]])})
    (logits,) = evaluate(pieces.pruner, weights, dict(zip(pieces.condition.outputs, values, strict=True)))
    assert logits.shape == (2, 5, 1, 4) and logits.isfinite().all()


def test_a_weight_with_a_name_of_the_plan_head_is_refused() -> None:
    program = labelled()
    named = replace(program, weights={**program.weights, "pruner.hidden.bias": program.weights["v"]})
    with pytest.raises(PassError, match=r"weights of its own called pruner\.hidden\.bias"):
        InsertPruner()(named)


class Picks(nn.Module):
    """A row of each stream, by number, of what the step knows and of what the loop knows."""

    def __init__(self) -> None:
        super().__init__()
        self.ff = nn.Linear(2, 2)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        streams, last = torch.arange(len(obs)), obs[:, :, 0].argmax(1)
        known = (obs[..., :2] * timestep[:, None, None]).flatten(0, 1)[last + 3 * streams]
        x = sample + torch.tanh(self.ff(sample)) * known[:, None]
        return x + self.ff(x) * x[streams, last][:, None]


class Examples(Picks):
    """One timestep for all streams; the sample gives a dtype and a shape to what does not depend on it."""

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        time = timestep[0].float().type_as(sample) * (obs[:, :1, :2] + torch.full_like(sample, 0.5))
        x = sample + self.ff(sample) * time
        return x + self.ff(x) * time * sample.new_ones(len(sample), 1, 1)


@pytest.mark.parametrize("module", [Picks, Examples])
def test_what_is_no_function_of_one_stream_and_one_step(module: type[nn.Module]) -> None:
    torch.manual_seed(0)
    original = module().eval()
    program = transform(original, toy_spec(obs=(3, 7)))
    assert len(program.blocks) == 2
    sample, obs = torch.randn(STREAMS, 4, 2), torch.randn(STREAMS, 3, 7)
    for k, t in enumerate(program.spec.sampler.timesteps):
        with torch.no_grad(), Counted() as counted:
            expected = original(sample, torch.full((STREAMS,), int(t)), obs)
        found = evaluate_pieces(program, sample, obs, k)
        assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)


class Shaped(Picks):
    """Of the observation it takes only the shape."""

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        time = torch.full_like(obs[:, :1, :2], 0.3) * timestep[:, None, None]
        x = sample + self.ff(sample) * time
        return x + self.ff(x) * time


def test_the_record_of_a_network_that_reads_no_observation() -> None:
    program = transform(Shaped(), toy_spec(obs=(3, 7)))
    assert record_original(Shaped(), program).residuals.any(axis=(1, 2, 3))[0]
