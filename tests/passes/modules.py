"""Denoisers for the tests of passes, compiled once, and their pieces evaluated one by one."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn

from tests.passes.graphs import B, Builder
from tests.passes.specs import toy_spec
from ttscompile import ObservationSpec, PolicySpec
from ttscompile.driver import transform
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Batch, Graph, Ref
from ttscompile.ir.pieces import LoopPiece
from ttscompile.ir.program import Binding, Captured, Pieces, Program
from ttscompile.passes.find_residual_blocks import find_residual_blocks
from ttscompile.passes.hoist import Hoist
from ttscompile.passes.partition import Partition
from ttscompile.policies.networks.conditional_unet1d import ConditionalUnet1D, UNetConfig

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


class Skipping(nn.Module):
    """A transformer that predicts how its prediction differs from the sample."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.net = TokenDecoder()

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return sample + self.net(sample, timestep, obs)


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
        layers: Any = self.layers
        for layer in layers:
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


class UNet(nn.Module):
    """Convolutions with skips around them, no residual stream: it becomes one block."""

    def __init__(self) -> None:
        super().__init__()
        sizes: Any = {"diffusion_step_embed_dim": 8, "down_dims": (8, 16), "cond_predict_scale": True}
        self.net = ConditionalUnet1D(UNetConfig(2, global_cond_dim=21, **sizes))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return self.net(sample, timestep, obs.flatten(1))


MODULES: dict[str, Callable[[], nn.Module]] = {
    "tokens": TokenDecoder,
    "condition encoder mixes tokens": lambda: TokenDecoder(encoder_layers=1),
    "adaLN": AdaLN,
    "sequence first": SequenceFirst,
    "bare observation": BareObservation,
    "U-Net": UNet,
}


def evaluate_pieces(program: Program, sample: torch.Tensor, obs: torch.Tensor, k: int) -> torch.Tensor:
    """One denoiser evaluation through the pieces, literally as docs/design.md describes them."""
    pieces = program.pieces
    contexts = contexts_at(program, pieces, {"obs": obs}, k)

    def run(piece: LoopPiece, value: torch.Tensor) -> torch.Tensor:
        read = {name: contexts[name] for name in piece.contexts}
        return run_graph(program, piece.graph, {piece.stream: value, **read})[0]

    stream = run(pieces.stem, sample)
    for block in pieces.blocks:
        stream = stream + run(block, stream)
    return run(pieces.tail, stream)


def contexts_at(program: Program, pieces: Pieces, obs: Mapping[str, torch.Tensor], k: int) -> dict[str, torch.Tensor]:
    steps = program.spec.sampler.steps
    values = dict(zip(pieces.condition.outputs, run_graph(program, pieces.condition, obs), strict=True))
    types = {n: t for piece in pieces.loop.values() for n, t in piece.contexts.items()}

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
        for name, value in zip(pieces.step.outputs, run_graph(program, pieces.step, inputs), strict=True):
            axis = pieces.step.types()[name].batch_axis
            assert axis is not None
            values[name] = value.narrow(axis, k * STREAMS, STREAMS)
    for name in pieces.tables:
        if name in types:
            values[name] = row(name, k, types[name].batch_axis)
    return values


def run_graph(program: Program, graph: Graph, inputs: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
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


SHAPE = (B, 4, 2)


def hoisted(builder: Builder, result: Ref, observation: ObservationSpec) -> Program:
    """The program of a graph of ``sample``, ``timestep`` and ``obs``, up to hoist."""
    graph = builder.graph(result)
    weights = {name: torch.randn(type_.at(1)).numpy() for name, type_ in graph.constants.items()}
    spec = replace(toy_spec(), observations={"obs": observation})
    blocks = find_residual_blocks(graph, "sample").blocks
    return Hoist()(Partition(blocks)(Captured(spec, graph, weights)).program).program


def graph_inputs(dtype: str) -> tuple[Builder, Ref, Ref]:
    """A builder, the sample and the observation."""
    b = Builder()
    sample = b.input("sample", *SHAPE)
    b.input("timestep", B, dtype="int64")
    return b, sample, b.input("obs", B, 3, dtype=dtype)


def labelled() -> Program:
    """Labels that go through an embedding: no arithmetic has made anything that the pruner could read."""
    b, sample, obs = graph_inputs("int64")
    rows = b.op("e", "embedding.default", (B, 3, 2), b.constant("w", 9, 2), obs)
    gate = b.op("gate", "mean.dim", (B, 1, 2), rows, (1,), True)
    linear = b.op("f", "linear.default", SHAPE, sample, b.constant("v", 2, 2))
    total = b.op("y", "add.Tensor", SHAPE, sample, b.op("g", "mul.Tensor", SHAPE, linear, gate))
    return hoisted(b, total, ObservationSpec((3,), dtype="int64", window=False, bounds=(0, 8)))


TWICE = (Batch(2), 4, 2)


class Doubled(nn.Module):
    """A residual on a batch that ``double`` makes of the sample, and ``halve`` makes one of again."""

    def __init__(self, double: Callable[[torch.Tensor], torch.Tensor], halve: Callable[..., torch.Tensor]) -> None:
        super().__init__()
        self.ff, self.twice, self.halve = nn.Linear(2, 2), double, halve

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        x = self.twice(sample) * self.twice(obs)[:, None, :2]
        x = x + torch.tanh(self.ff(x)) * self.twice(timestep)[:, None, None]
        return self.halve(x + self.ff(x))


HALVES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "slices": lambda x: x[: len(x) // 2] - 0.3 * x[len(x) // 2 :],
    "split": lambda x: torch.sub(*torch.split(x, len(x) // 2)),
    "chunk": lambda x: torch.sub(*x.chunk(2)),
}
