"""The passes in the driver's order, on real modules: what they compute stays the same, what is hoisted is counted."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from tests.passes.specs import toy_spec
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import PolicySpec
from ttscompile.driver import _run as _pass
from ttscompile.driver import transform
from ttscompile.errors import NoResidualBlocksError, PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.graph import Graph
from ttscompile.ir.program import Binding, Pieces, Program
from ttscompile.passes.base import PassResult
from ttscompile.passes.clean_up import CleanUp
from ttscompile.passes.hoist import Hoist
from ttscompile.passes.insert_pruner import InsertPruner
from ttscompile.passes.insert_reuse import InsertReuse
from ttscompile.passes.partition import Partition
from ttscompile.passes.split_tokens import SplitTokens

STREAMS = 2


class TokenDecoder(nn.Module):
    """Cross-attention to a time token and observation tokens that an MLP encodes token by token."""

    def __init__(self, width: int = 16, layers: int = 2, encoder_layers: int = 0) -> None:
        super().__init__()
        decoder = nn.TransformerDecoderLayer
        self.layers = nn.ModuleList(
            decoder(width, 2, 32, 0.0, "gelu", batch_first=True, norm_first=True) for _ in range(layers)
        )
        self.encoders = nn.ModuleList(
            nn.TransformerEncoderLayer(width, 2, 32, 0.0, "gelu", batch_first=True, norm_first=True)
            for _ in range(encoder_layers)
        )
        self.embed, self.head = nn.Linear(2, width), nn.Linear(width, 2)
        self.obs, self.mlp = nn.Linear(7, width), nn.Sequential(nn.Linear(width, 32), nn.Mish(), nn.Linear(32, width))
        self.frequencies = nn.Buffer(torch.arange(1, width // 2 + 1) / 5)
        self.position = nn.Parameter(torch.randn(1, 4, width))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        angle = timestep[:, None].float() * self.frequencies
        time = torch.cat([angle.sin(), angle.cos()], -1)
        memory = self.mlp(torch.cat([time[:, None], self.obs(obs)], 1) + self.position)
        for encoder in self.encoders:
            memory = encoder(memory)
        h = self.embed(sample)
        for layer in self.layers:
            h = layer(h, memory)
        return self.head(h)


class AdaLN(nn.Module):
    """Gated blocks modulated by time + observation: step work, all of it outside the loop."""

    def __init__(self, width: int = 16, layers: int = 2) -> None:
        super().__init__()
        self.embed, self.head, self.obs = nn.Linear(2, width), nn.Linear(width, 2), nn.Linear(7, width)
        self.modulation = nn.ModuleList(nn.Linear(width, 3 * width) for _ in range(layers))
        self.ff = nn.ModuleList(
            nn.Sequential(nn.Linear(width, 32), nn.GELU(), nn.Linear(32, width)) for _ in range(layers)
        )

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        c = nn.functional.silu(timestep[:, None] * 0.1 + self.obs(obs).mean(1))
        h = self.embed(sample)
        for modulation, ff in zip(self.modulation, self.ff, strict=True):
            shift, scale, gate = modulation(c)[:, None].chunk(3, -1)
            h = h + gate * ff(nn.functional.layer_norm(h, h.shape[-1:]) * (1 + scale) + shift)
        return self.head(h)


class SequenceFirst(TokenDecoder):
    """The same with the stream as [T, B, E] inside."""

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        h = self.embed(sample).transpose(0, 1).contiguous()
        bias = self.obs(obs).transpose(0, 1).mean(0, keepdim=True) + timestep[None, :, None]
        for layer in self.layers:
            h = h + layer.linear2(torch.tanh(layer.linear1(h) + bias.mean(-1, keepdim=True)))
        return self.head(h.transpose(0, 1))


class BareObservation(nn.Module):
    """The loop reads observation and timestep directly: nothing to encode."""

    def __init__(self) -> None:
        super().__init__()
        self.ff = nn.Linear(2, 2)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        h = sample + self.ff(sample * obs[:, :1, :2]) * timestep[:, None, None]
        return h + self.ff(h)


MODULES = {
    "tokens": TokenDecoder,
    "condition encoder mixes tokens": lambda: TokenDecoder(encoder_layers=1),
    "adaLN": AdaLN,
    "sequence first": SequenceFirst,
    "bare observation": BareObservation,
}


def evaluate_pieces(program: Program, sample: torch.Tensor, obs: torch.Tensor, k: int) -> torch.Tensor:
    """One denoiser evaluation through the pieces, literally as docs/design.md describes them."""
    pieces = program.pieces
    assert pieces is not None
    contexts = contexts_at(program, pieces, {"obs": obs}, k)

    def run(graph: Graph, value: torch.Tensor) -> torch.Tensor:
        first, *rest = graph.inputs
        return _run(program, graph, {first: value, **{n: contexts[n] for n in rest}})[0]

    stream = run(pieces.stem, sample)
    for block in pieces.blocks:
        stream = stream + run(block, stream)
    return run(pieces.tail, stream)


def contexts_at(program: Program, pieces: Pieces, obs: Mapping[str, torch.Tensor], k: int) -> dict[str, torch.Tensor]:
    steps = program.spec.sampler.steps
    values = dict(zip(pieces.condition.outputs, _run(program, pieces.condition, obs), strict=True))
    types = {n: t for g in (pieces.stem, *pieces.blocks, pieces.tail) for n, t in g.inputs.items()}

    def row(name: str, step: int, axis: int | None) -> torch.Tensor:
        table = torch.from_numpy(np.asarray(pieces.tables[name][step]))
        return table if axis is None else table.repeat_interleave(STREAMS, axis)

    if pieces.step is not None:
        inputs = {}
        for name, type_ in pieces.step.inputs.items():
            axis = type_.batch_axis
            assert axis is not None
            table = pieces.bindings[name] is Binding.TABLE
            rows = [row(name, s, axis) if table else values[name] for s in range(steps)]
            inputs[name] = torch.cat(rows, axis)
        for name, value in zip(pieces.step.outputs, _run(program, pieces.step, inputs), strict=True):
            axis = pieces.step.types()[name].batch_axis
            assert axis is not None
            values[name] = value.narrow(axis, k * STREAMS, STREAMS)
    for name in pieces.tables:
        if name in types:
            values[name] = row(name, k, types[name].batch_axis)
    return values


def _run(program: Program, graph: Graph, inputs: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
    return evaluate(graph, {n: torch.from_numpy(np.asarray(program.weights[n])) for n in graph.constants}, inputs)


def spec() -> PolicySpec:
    return toy_spec(sample=(4, 2), obs=(3, 7))


@functools.cache
def explained(name: str) -> tuple[nn.Module, Program, dict[str, tuple[str, ...]]]:
    """Capture is the slow part; programs are immutable, so tests share them, and what each stage told."""
    torch.manual_seed(0)
    module, told = MODULES[name]().eval(), dict[str, tuple[str, ...]]()
    return module, transform(module, spec(), explain=lambda stage, notes: told.update({stage: notes})), told


def compiled(name: str) -> tuple[nn.Module, Program]:
    """A module and its program."""
    return explained(name)[:2]


@pytest.mark.parametrize("name", MODULES)
def test_the_pieces_compute_what_the_module_computes(name: str) -> None:
    module, program = compiled(name)
    for k, t in enumerate(program.spec.sampler.timesteps):
        sample, obs = torch.randn(STREAMS, 4, 2), torch.randn(STREAMS, 3, 7)
        with torch.no_grad(), Counted() as counted:
            expected = module(sample, torch.full((STREAMS,), int(t)), obs)
        found = evaluate_pieces(program, sample, obs, k)
        assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)


def test_time_token_becomes_a_table_and_observation_tokens_are_encoded_once() -> None:
    _, program = compiled("tokens")
    pieces = program.pieces
    assert pieces is not None and pieces.step is None
    # Keys and values of two layers: a table row for the time token, a condition value for the three observation tokens.
    assert len(pieces.tables) == 4
    assert all(table.shape[0] == 5 and table.shape[3] == 1 for table in pieces.tables.values())
    width, tokens = 16, 3
    encode = 2 * tokens * (7 * width + 2 * width * 32)
    keys_and_values = 2 * tokens * (2 * width * width) * 2
    assert graph_flops(pieces.condition) == encode + keys_and_values
    # Nothing but self-attention, queries, cross-attention itself, feed-forward, embedding and head is left in the loop.
    loop = sum(graph_flops(g) for g in (pieces.stem, *pieces.blocks, pieces.tail))
    attention = lambda keys: 2 * 4 * keys * 2 * width  # noqa: E731
    layer = (
        2 * 4 * width * (4 * width) + attention(4) + 2 * 4 * width * (2 * width) + attention(4) + 2 * 4 * 2 * width * 32
    )
    assert loop == 2 * layer + 2 * (2 * 4 * 2 * width)


def test_a_mixing_condition_encoder_runs_all_steps_in_one_batch() -> None:
    _, program = compiled("condition encoder mixes tokens")
    assert program.pieces is not None and program.pieces.step is not None
    assert Binding.STEP in program.pieces.bindings.values()


def test_modulations_leave_the_loop() -> None:
    _, program = compiled("adaLN")
    pieces = program.pieces
    assert pieces is not None and pieces.step is not None
    assert graph_flops(pieces.step) == 2 * 2 * 16 * 48
    assert [b.flops for b in program.blocks] == [2 * 4 * 2 * 16 * 32] * 2


def test_stages_are_explained() -> None:
    told = explained("tokens")[2]
    assert list(told) == [
        "capture", "CleanUp", "CutCopies", "WidenAttention", "RegroupSums", "find_residual_blocks", "Partition",
        "UnfoldBatch", "SplitTokens", "SplitFeatures", "Hoist", "InsertPruner", "InsertReuse",
    ]  # fmt: skip
    assert "6 blocks: self_attention, cross_attention, feed_forward" in told["find_residual_blocks"][0]
    assert any("left in the loop" in note for note in told["Hoist"])


def test_passes_run_in_their_order_only() -> None:
    _, program = compiled("tokens")
    bare = Program(program.spec, program.denoiser, program.weights)
    for each in (Partition(), SplitTokens(), Hoist(), InsertPruner(), InsertReuse()):
        with pytest.raises(PassError, match=f"^{each.name}: "):
            each(bare)
    with pytest.raises(PassError, match="already cut"):
        Partition()(program)


def test_clean_up_and_insert_reuse_are_idempotent() -> None:
    _, program = compiled("tokens")
    for each in (CleanUp(), InsertReuse()):
        result = each(program)
        assert result.program is program and not result.modified


def test_pruner_reads_the_encoded_observation_and_forces_step_zero() -> None:
    _, program = compiled("tokens")
    pieces = program.pieces
    assert pieces is not None and pieces.pruner is not None
    (feature,) = pieces.features
    assert pieces.condition.types()[feature].shape[-1] == 16
    features = dict(
        zip(pieces.condition.outputs, _run(program, pieces.condition, {"obs": torch.randn(2, 3, 7)}), strict=True)
    )
    (logits,) = _run(program, pieces.pruner, {feature: features[feature]})
    assert logits.shape == (2, 5, 6, 4)
    assert (logits[:, 0, :, 1:] < -1e8).all() and (logits.argmax(-1) == 0).all()


def test_pruner_shrinks_until_it_costs_one_percent_and_says_when_it_cannot() -> None:
    large = transform(TokenDecoder(width=64).eval(), spec())
    assert large.pieces is not None and large.pieces.pruner is not None
    assert graph_flops(large.pieces.pruner) <= 0.01 * large.dense_flops
    told = explained("bare observation")[2]
    assert any("more than 1% even at its smallest" in note for note in told["InsertPruner"])


class LongObservation(nn.Module):
    """Reads the observation as it is, and there is much of it."""

    def __init__(self) -> None:
        super().__init__()
        self.ff = nn.Linear(2, 2)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return sample + self.ff(sample * obs[:, :4, :2] * obs[:, -4:, -2:])


def test_a_pass_that_breaks_the_program_is_named() -> None:
    class Breaks(InsertReuse):
        def call(self, program: Program) -> PassResult:
            return PassResult(replace(program, weights={}), True)

    _, program = compiled("tokens")
    with pytest.raises(PassError, match=r"^after Breaks: denoiser: constant %\S+ has no value"):
        _pass(Breaks(), program, lambda stage, notes: None)


def test_pruner_averages_a_feature_that_is_huge() -> None:
    program = transform(LongObservation().eval(), toy_spec(obs=(600, 40)))
    assert program.pieces is not None and program.pieces.pruner is not None
    assert program.weights["pruner.hidden.weight"].shape[1] == 40
    (feature,) = program.pieces.features
    obs = torch.randn(2, 600, 40)
    (logits,) = _run(program, program.pieces.pruner, {feature: obs})
    with Counted() as counted:
        (same,) = _run(program, program.pieces.pruner, {feature: obs.mean(1, keepdim=True).expand(-1, 600, -1)})
    free = same.abs() < 1e6  # step 0 has the logits of a plan that is forced
    assert_equal_but_for_rounding(logits, same, counted.terms)
    assert_equal_but_for_rounding(logits[free], same[free], counted.terms)


class NoResidual(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(2, 8), nn.GELU(), nn.Linear(8, 2))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return self.net(sample) * obs.flatten(1).mean(1)[:, None, None] * timestep[:, None, None]


def test_a_network_without_residuals_is_refused_with_its_source_line() -> None:
    with pytest.raises(
        NoResidualBlocksError, match=r"ended at %\w+ = aten\.mul\.Tensor \(test_pipeline\.py:\d+ in forward\)"
    ):
        transform(NoResidual(), spec())
