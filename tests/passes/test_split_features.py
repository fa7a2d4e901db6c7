"""A linear layer of concatenated features becomes a sum, and only where that takes work out of the loop."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn

from tests.passes.graphs import B, Builder
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.capture.export import capture
from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.ir.binding import bindings
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Batch, Graph, Node, Ref, TensorType
from ttscompile.ir.program import Binding, Captured, Cut
from ttscompile.passes.clean_up import CleanUp
from ttscompile.passes.find_residual_blocks import find_residual_blocks
from ttscompile.passes.hoist import Hoist
from ttscompile.passes.partition import Partition
from ttscompile.passes.split_tokens import SplitFeatures, SplitTokens, _features


class _Modulated(nn.Module):
    """One gated block; its gate is linear in [time, observation, time], or in the observation twice."""

    def __init__(self, with_time: bool) -> None:
        super().__init__()
        self.with_time = with_time
        self.gate, self.f = nn.Linear(10, 4), nn.Linear(4, 4)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        time = torch.stack((timestep.sin(), timestep.cos()), -1)
        parts = (time, obs, time) if self.with_time else (obs, obs[:, :4])
        gate = self.gate(torch.cat(parts, -1))
        return sample + gate[:, None] * torch.tanh(self.f(sample))


def _program(with_time: bool) -> Cut:
    """Cut, with its tokens split, not hoisted."""
    torch.manual_seed(0)
    columns: Any = {name: np.ones(3) for name in SamplerTable.COLUMNS}
    sampler = SamplerTable(name="x", timesteps=np.array([0.3, 0.2, 0.1], np.float32), clip=None, **columns)
    spec = PolicySpec((5, 4), {"obs": ObservationSpec((6,))}, sampler, ChunkSpec(4, 0, 5))
    graph, weights = capture(_Modulated(with_time), spec)
    captured = Captured(spec, graph, weights, dense_flops=1000)
    return SplitTokens()(Partition(find_residual_blocks(graph, "sample").blocks)(captured).program).program


def test_modulations_become_a_sum_of_a_table_and_a_condition() -> None:
    before = _program(True)
    result = SplitFeatures()(before)
    assert result.notes == ("1 linear layers of features with different binding times became sums",)
    inputs = {"timestep": torch.rand(2), "obs": torch.randn(2, 6)}
    values = []
    for program in (before, result.program):
        weights = {name: torch.from_numpy(value) for name, value in program.weights.items()}
        with Counted() as counted:
            values.append(evaluate(program.prologue, weights, inputs))
    for one, other in zip(*values, strict=True):
        assert_equal_but_for_rounding(one, other, counted.terms)
    pieces = Hoist()(CleanUp[Cut]()(result.program).program).program.pieces
    assert pieces.step is not None
    assert not any("linear" in node.op for node in pieces.step.nodes)
    assert any("linear" in node.op for node in pieces.condition.nodes)
    again = SplitFeatures()(result.program)
    assert again.program is result.program


def test_features_of_one_binding_time_are_left_alone() -> None:
    program = _program(False)
    assert SplitFeatures()(program).program is program


def test_features_of_another_dtype_stay_together() -> None:
    b = Builder()
    parts = (b.input("time", B, 2), b.input("count", B, 3, dtype="int64"))
    b.op("gate", "linear.default", (B, 4), b.op("both", "cat.default", (B, 5), parts, 1), b.constant("w", 4, 5))
    graph = b.graph(Ref("gate"))
    assert _features(graph.nodes[1], graph.producers(), graph.types()) == []
    floats = {name: replace(type_, dtype="float32") for name, type_ in graph.types().items()}
    assert _features(graph.nodes[1], graph.producers(), floats) == ["time", "count"]


def test_a_class_token_for_every_image_is_no_table() -> None:
    """``expand(B, 1, D)`` of a constant: a table by itself, but beside an observation what the observation is."""
    row, batch = TensorType((1, 1, 4), "float32"), TensorType((Batch(), 1, 4), "float32")
    both = TensorType((Batch(), 2, 4), "float32")
    token = Node("token", "aten.expand.default", (Ref("w"), (Batch(), -1, -1)), (), (batch,))
    moved = Node("moved", "aten.neg.default", (Ref("token"),), (), (batch,))
    seen = Node("seen", "aten.cat.default", ((Ref("moved"), Ref("obs")), 1), (), (both,))
    timed = Node("timed", "aten.cat.default", ((Ref("moved"), Ref("time")), 1), (), (both,))
    graph = Graph({"obs": batch, "time": batch}, {"w": row}, (token, moved, seen, timed), ("seen", "timed"))
    found = bindings(graph, {"obs": Binding.CONDITION, "time": Binding.TABLE})
    wanted = {"token": Binding.TABLE, "moved": Binding.TABLE, "seen": Binding.CONDITION, "timed": Binding.TABLE}
    assert {name: found[name] for name in wanted} == wanted
