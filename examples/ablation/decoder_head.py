"""The plan head of the paper, in place of ours: a decoder layer over the features of the policy's own encoder.

    python examples/ablation/decoder_head.py CHECKPOINT DIR

writes the artifact of a checkpoint with this head, which ``at_its_word.py`` trains. Runtimes execute its plans as those
of the other head: both are a graph from features to logits.

What the authors' code has is here (arXiv 2605.13316, https://github.com/ky-ji/Test-time-Sparsity at ab1c72b): one
pre-norm decoder layer, whose queries are sinusoidal codes of the blocks, and whose memory at a step are the features
and the time of that step. Each query attends to the others and to the memory, and goes through a feed-forward. The
token of the time is the policy's own, after its encoder, as theirs; a policy whose encoder does not take tokens one by
one has a sinusoidal code instead. ``dropped.py`` has their dropout, for the training.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from ttscompile.artifact.write import write_artifact
from ttscompile.driver import transform
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.graph import Argument, Batch, Graph, Node, Ref, Size, TensorType
from ttscompile.ir.plan_head import MASKED, SOURCES
from ttscompile.ir.program import Program
from ttscompile.lower.program import lower_program
from ttscompile.passes.base import Pass, PassResult
from ttscompile.policies.networks.transformer_for_diffusion import TransformerForDiffusion
from ttscompile.verification.record_golden import record_original

BASE = "pruner.base"
"""What is added to the logits of each cell, whatever is observed; training writes the price of computing into it."""

FIXED = frozenset(("pruner.query", "pruner.time", "pruner.mask"))
"""Constants that no training changes."""

Parameters = dict[str, npt.NDArray[np.float32]]


@dataclass(frozen=True)
class DecoderHead(Pass[Program, Program]):
    """Put the paper's head where ``InsertPruner`` has put the low-rank one.

    After::

        query  = code[b] + attention(norm(code))                              # [blocks, width]
        memory = linear(features), linear(time[k])                            # [B, K, tokens + 1, width]
        tokens = query + attention(norm(query), memory)                       # [B, K, blocks, width]
        tokens = tokens + narrow(relu(wide(norm(tokens))))
        logits = head(tokens) + base + mask                                   # [B, K, blocks, 4]

    Attributes:
        width: theirs is 512, beside policies of width 256.
        inner: of the feed-forward; theirs is 1024.
        heads: of the attention, as theirs.
        time: what the policy makes of each step's time, ``[K, size]``; None for sinusoidal codes.
    """

    width: int = 128
    inner: int = 256
    heads: int = 8
    time: npt.NDArray[np.float32] | None = None

    def call(self, program: Program) -> PassResult[Program]:
        pieces, steps, blocks = program.pieces, program.spec.sampler.steps, len(program.blocks)
        if pieces.pruner is None:
            raise self.fail("expected a program with a plan head: run InsertPruner first.")
        if self.width % (2 * self.heads):
            raise self.fail(f"a width of {self.width}: expected a multiple of twice the {self.heads} heads.")
        features = pieces.pruner.inputs
        tokens = {name: tokens_of(type_) for name, type_ in features.items()}
        parameters = self._first_numbers(tokens, [float(t) for t in program.spec.sampler.timesteps], blocks)
        graph = _Head(self, features, tokens, parameters, steps, blocks).graph()
        weights = {name: value for name, value in program.weights.items() if name not in pieces.pruner.constants}
        new = replace(program, pieces=replace(pieces, pruner=graph), weights={**weights, **parameters})
        flops = graph_flops(graph)
        return PassResult(new, (f"{flops:,} FLOPs, {flops / max(program.dense_flops, 1):.2%} of a dense call",))

    def _first_numbers(
        self, tokens: Mapping[str, tuple[int, int]], timesteps: Sequence[float], blocks: int
    ) -> Parameters:
        """Those that torch's modules begin with: Xavier's and biases of 0, but of the feed-forward."""
        draw, d, steps = np.random.default_rng(0), self.width, len(timesteps)

        def uniform(rows: int, columns: int, bound: float) -> npt.NDArray[np.float32]:
            return draw.uniform(-bound, bound, (rows, columns)).astype(np.float32)

        def xavier(rows: int, columns: int, of: int = 0) -> npt.NDArray[np.float32]:
            return uniform(rows, columns, math.sqrt(6 / ((of or rows) + columns)))

        sizes = {"self.in": (3 * d, d), "self.out": (d, d), "cross.q": (d, d), "cross.k": (d, d), "cross.v": (d, d)}
        sizes |= {"cross.out": (d, d), "wide": (self.inner, d), "narrow": (d, self.inner), "head": (SOURCES, d)}
        time = _codes(timesteps, d) if self.time is None else self.time
        sizes |= {f"memory{i}": (d, size) for i, (_, size) in enumerate(tokens.values())}
        sizes["clock"] = d, time.shape[1]
        found: Parameters = {"pruner.query": _codes(np.arange(blocks), d), "pruner.time": time}
        for name, (rows, columns) in sizes.items():
            value = (
                uniform(rows, columns, columns**-0.5) if name in ("wide", "narrow", "self.out", "cross.out") else None
            )
            joint = 3 * d if name.startswith("cross") else 0  # torch draws the three projections as one matrix
            found[f"pruner.{name}.weight"] = xavier(rows, columns, joint) if value is None else value
            found[f"pruner.{name}.bias"] = np.zeros(rows, np.float32)
            if name in ("wide", "narrow"):
                found[f"pruner.{name}.bias"] = uniform(1, rows, columns**-0.5)[0]
        for i in (1, 2, 3):
            found[f"pruner.norm{i}.weight"], found[f"pruner.norm{i}.bias"] = (
                make(d, np.float32) for make in (np.ones, np.zeros)
            )
        mask = np.zeros((steps, blocks, SOURCES), np.float32)
        mask[0, :, 1:] = MASKED
        base = np.zeros_like(mask)
        base[..., 0] = 1e3  # dense until trained
        return {**found, BASE: base, "pruner.mask": mask}


class _Head:
    """Writes the graph, node by node."""

    def __init__(
        self,
        shape: DecoderHead,
        features: Mapping[str, TensorType],
        tokens: Mapping[str, tuple[int, int]],
        parameters: Parameters,
        steps: int,
        blocks: int,
    ) -> None:
        self._shape, self._features, self._tokens, self._parameters = shape, dict(features), tokens, parameters
        self._steps, self._blocks, self._nodes = steps, blocks, list[Node]()

    def graph(self) -> Graph:
        """Features -> logits ``[B, K, blocks, 4]``."""
        d, cells = self._shape.width, (Batch(), self._steps, self._blocks)
        alone = self._attended_alone()
        query = self._linear("query", "cross.q", self._norm("norm2", 2, alone, (self._blocks, d)), (self._blocks, d))
        seen = self._attended("cross", query, self._memory())
        tokens = self._emit("tokens", "add.Tensor", (*cells, d), seen, alone)
        wide = self._linear("wide", "wide", self._norm("norm3", 3, tokens, (*cells, d)), (*cells, self._shape.inner))
        active = self._emit("active", "relu.default", (*cells, self._shape.inner), wide)
        narrow = self._linear("narrow", "narrow", active, (*cells, d))
        tokens = self._emit("out", "add.Tensor", (*cells, d), tokens, narrow)
        logits = self._linear("cells", "head", tokens, (*cells, SOURCES))
        logits = self._emit("based", "add.Tensor", (*cells, SOURCES), logits, Ref(BASE))
        logits = self._emit("logits", "add.Tensor", (*cells, SOURCES), logits, Ref("pruner.mask"))
        constants = {name: TensorType(value.shape, "float32") for name, value in self._parameters.items()}
        return Graph(self._features, constants, tuple(self._nodes), (logits.name,))

    def _attended_alone(self) -> Ref:
        """The codes of the blocks, each after having looked at the others: the same at all steps of all calls."""
        d, heads, blocks = self._shape.width, self._shape.heads, self._blocks
        normed = self._norm("norm1", 1, Ref("pruner.query"), (blocks, d))
        joint = self._linear("joint", "self.in", normed, (blocks, 3 * d))
        split = self._emit(
            "split", "reshape.default", (blocks, 3, heads, d // heads), joint, (blocks, 3, heads, d // heads)
        )
        by_head = self._emit("by_head", "permute.default", (3, heads, blocks, d // heads), split, (1, 2, 0, 3))
        q, k, v = (
            self._emit(f"own_{name}", "select.int", (heads, blocks, d // heads), by_head, 0, i)
            for i, name in enumerate("qkv")
        )
        turned = self._emit("own_turned", "permute.default", (heads, d // heads, blocks), k, (0, 2, 1))
        looked = self._look("own", q, turned, v, (heads, blocks), blocks)
        back = self._emit("own_back", "permute.default", (blocks, heads, d // heads), looked, (1, 0, 2))
        flat = self._emit("own_flat", "reshape.default", (blocks, d), back, (blocks, d))
        return self._emit(
            "alone",
            "add.Tensor",
            (blocks, d),
            self._linear("own_out", "self.out", flat, (blocks, d)),
            Ref("pruner.query"),
        )

    def _memory(self) -> Ref:
        """Features and the time, as tokens, ``[B, K, tokens + 1, width]``."""
        d, steps, parts = self._shape.width, self._steps, list[Ref]()
        for i, (name, (count, size)) in enumerate(self._tokens.items()):
            axis, value = self._features[name].batch_axis or 0, Ref(name)
            shape = self._features[name].shape
            if axis:
                order = (axis, *(a for a in range(len(shape)) if a != axis))
                value = self._emit(f"batch_first{i}", "permute.default", tuple(shape[a] for a in order), value, order)
            flat = self._emit(
                f"flat{i}", "reshape.default", (Batch(), 1, count, size), value, (Batch(), 1, count, size)
            )
            made = self._linear(f"memory{i}", f"memory{i}", flat, (Batch(), 1, count, d))
            parts.append(
                self._emit(
                    f"all_steps{i}", "expand.default", (Batch(), steps, count, d), made, (Batch(), steps, count, d)
                )
            )
        time = self._linear("clock", "clock", Ref("pruner.time"), (steps, d))
        row = self._emit("clock_row", "reshape.default", (1, steps, 1, d), time, (1, steps, 1, d))
        parts.append(self._emit("all_calls", "expand.default", (Batch(), steps, 1, d), row, (Batch(), steps, 1, d)))
        return self._emit("memory", "cat.default", (Batch(), steps, self._count, d), tuple(parts), 2)

    @property
    def _count(self) -> int:
        return 1 + sum(count for count, _ in self._tokens.values())

    def _attended(self, name: str, query: Ref, memory: Ref) -> Ref:
        """What ``[blocks, width]`` see in the memory of each step, ``[B, K, blocks, width]``."""
        d, heads, blocks, steps, count = self._shape.width, self._shape.heads, self._blocks, self._steps, self._count
        part = d // heads
        split = self._emit("q_split", "reshape.default", (blocks, heads, part), query, (blocks, heads, part))
        q = self._emit("q", "permute.default", (heads, blocks, part), split, (1, 0, 2))
        turned = dict[str, Ref]()
        for letter, order, last in (("k", (0, 1, 3, 4, 2), (part, count)), ("v", (0, 1, 3, 2, 4), (count, part))):
            made = self._linear(f"{letter}_rows", f"{name}.{letter}", memory, (Batch(), steps, count, d))
            shape = (Batch(), steps, count, heads, part)
            made = self._emit(f"{letter}_split", "reshape.default", shape, made, shape)
            turned[letter] = self._emit(letter, "permute.default", (Batch(), steps, heads, *last), made, order)
        looked = self._look("seen", q, turned["k"], turned["v"], (Batch(), steps, heads, blocks), count)
        back = self._emit(
            "seen_back", "permute.default", (Batch(), steps, blocks, heads, part), looked, (0, 1, 3, 2, 4)
        )
        flat = self._emit(
            "seen_flat", "reshape.default", (Batch(), steps, blocks, d), back, (Batch(), steps, blocks, d)
        )
        return self._linear("seen_out", f"{name}.out", flat, (Batch(), steps, blocks, d))

    def _look(self, name: str, q: Ref, k: Ref, v: Ref, rows: tuple[Size, ...], count: int) -> Ref:
        part = self._shape.width // self._shape.heads
        product = self._emit(f"{name}_product", "matmul.default", (*rows, count), q, k)
        scaled = self._emit(f"{name}_scaled", "mul.Scalar", (*rows, count), product, part**-0.5)
        shares = self._emit(f"{name}_shares", "softmax.int", (*rows, count), scaled, -1)
        return self._emit(f"{name}_values", "matmul.default", (*rows, part), shares, v)

    def _norm(self, name: str, number: int, value: Ref, shape: tuple[Size, ...]) -> Ref:
        weights = (Ref(f"pruner.norm{number}.weight"), Ref(f"pruner.norm{number}.bias"))
        return self._emit(name, "layer_norm.default", shape, value, (self._shape.width,), *weights)

    def _linear(self, name: str, of: str, value: Ref, shape: tuple[Size, ...]) -> Ref:
        return self._emit(name, "linear.default", shape, value, Ref(f"pruner.{of}.weight"), Ref(f"pruner.{of}.bias"))

    def _emit(self, name: str, op: str, shape: tuple[Size, ...], *args: Argument) -> Ref:
        type_ = TensorType(shape, "float32")
        self._nodes.append(Node(f"plan.{name}", f"aten.{op}", args, (), (type_,), "the paper's plan head"))
        return Ref(f"plan.{name}")


def _codes(places: Sequence[float] | npt.NDArray[np.int64], width: int) -> npt.NDArray[np.float32]:
    """Sines and cosines of places, ``[n, width]``, of wavelengths from 2 pi to 20,000 pi."""
    rates = np.exp(-math.log(10000) / (width // 2 - 1) * np.arange(width // 2))
    angles = np.asarray(places, np.float64)[:, None] * rates
    return np.concatenate([np.sin(angles), np.cos(angles)], 1).astype(np.float32)


def time_tokens(module: nn.Module, timesteps: Sequence[int]) -> npt.NDArray[np.float32] | None:
    """What a policy's encoder makes of each step's time, ``[K, width]``; None if it does not take tokens one by one."""
    networks = [one for one in module.modules() if isinstance(one, TransformerForDiffusion)]
    if len(networks) != 1 or not isinstance(networks[0].encoder, nn.Sequential):
        return None
    network = networks[0]
    with torch.no_grad():
        time = network.time_emb(torch.tensor([int(one) for one in timesteps])).unsqueeze(1)
        return np.asarray(network.encoder(time + network.cond_pos_emb[:, :1])[:, 0].numpy(), np.float32)


def tokens_of(type_: TensorType) -> tuple[int, int]:
    """How many tokens a feature is, and of what size: its last axis is a token's."""
    axis, sizes = type_.batch_axis or 0, type_.at(1)
    rest = [n for i, n in enumerate(sizes) if i != axis]
    return math.prod(rest[:-1]), rest[-1] if rest else 1


@click.command(context_settings={"show_default": True})
@click.argument("checkpoint", type=click.Path(exists=True, path_type=Path))
@click.argument("directory", type=click.Path(path_type=Path))
@click.option("--width", default=DecoderHead.width)
@click.option("--inner", default=DecoderHead.inner, help="Of the feed-forward.")
def main(checkpoint: Path, directory: Path, width: int, inner: int) -> None:
    """Write the artifact of CHECKPOINT, in its own loop, with the paper's head to DIRECTORY."""
    module, spec = load_checkpoint_policy(checkpoint)
    head = DecoderHead(width=width, inner=inner, time=time_tokens(module, spec.sampler.timesteps.tolist()))
    made = head(transform(module, spec))
    program = made.program
    write_artifact(program, lower_program(program), directory, golden=record_original(module, program))
    click.echo(f"{directory}: its head has {made.notes[0]}")


if __name__ == "__main__":
    main()
