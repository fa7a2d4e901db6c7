"""The network of an artifact on a device: its constants, and what each piece computes for one number of streams."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from importlib import import_module

import torch
from torch import Tensor

from ttscompile.artifact.view import View
from ttscompile.core.coercion import Array, Arrays
from ttscompile.ir.graph import Graph, TensorType
from ttscompile.ir.idle_form import idle_form
from ttscompile.ir.pieces import BLOCKS, CONDITION, FRAMES, PRUNER, SCENE, STEM, STEP, TAIL, LoopPiece
from ttscompile.ir.program import once_values
from ttscompile.runtimes.contexts import ContextValues

from . import devices
from .functions import Function, write_function
from .sampler import IdleSteps


class Placed:
    """Arrays of an artifact on a device, each once."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._known: dict[int, tuple[Array, Tensor]] = {}  # by identity, which the entry keeps from reuse

    def all(self, arrays: Arrays) -> dict[str, Tensor]:
        """The tensors of these arrays, by name."""
        for array in arrays.values():
            if id(array) not in self._known:
                self._known[id(array)] = array, devices.placed(array, self.device)
        return {name: self._known[id(array)][1] for name, array in arrays.items()}


class Parts:
    """What all numbers of streams share; ``narrow`` is by part the type that its products are in, if not float32."""

    def __init__(self, view: View, placed: Placed) -> None:
        self.manifest, self.pieces, self.device = view.manifest, view.pieces, placed.device
        self.narrow = {part: devices.narrow_type(one, placed.device) for part, one in view.precision.items()}
        values = {**view.weights, **view.pruner}
        self.weights = placed.all(values)
        first = placed.all(view.first_weights)
        self.first = self.weights | first if first else self.weights
        form, _ = idle_form(self.pieces, values)
        self.idle = None if form is None else IdleSteps(form, placed.device)
        if self.idle is not None and placed.device.type == "cuda":
            with suppress(ModuleNotFoundError):  # Triton comes with most builds of torch for CUDA, not with all
                fused = import_module(f"{__package__}.fused")
                self.idle.fused = fused if fused.works(placed.device) else None

    def zeros(self, shape: tuple[int, ...], dtype: str) -> Tensor:
        """Zeros on the device."""
        return torch.zeros(shape, dtype=getattr(torch, dtype), device=self.device)


class StreamsNetwork:
    """The pieces for B streams, and the contexts that they read, which stay where they are.

    Args:
        parts: of the artifact.
        obs: what the prologue reads: observations by key, ``[B, ...]`` each.
        streams: B.

    Attributes:
        idle: see ``loop.Network``.
        contexts: what they read.
    """

    def __init__(self, parts: Parts, obs: Mapping[str, Tensor], streams: int) -> None:
        self._parts, self._obs, self.streams = parts, obs, streams
        manifest, pieces = parts.manifest, parts.pieces
        self._steps, self.idle = manifest.steps, parts.idle
        tables = {name: devices.placed(table, parts.device) for name, table in pieces.tables.items()}
        self.contexts = ContextValues(manifest, streams, torch, parts.zeros, tables)
        self._once: dict[str, Function] = {}
        self._step: Function | None = None
        self.contexts.keep(once_values(pieces, self._write_and_run, obs).items())
        if pieces.step is not None:
            reads = self.contexts.for_step_piece(pieces.step.inputs)
            self._step = self._written(STEP, pieces.step, reads, self._steps * streams)
            self.prologue()
        (horizon, dimensions), kind = manifest.spec.sample, manifest.blocks[0].type
        sample = torch.zeros((dimensions, streams, horizon), device=parts.device).permute(1, 2, 0)
        hidden = parts.zeros(kind.at(streams), kind.dtype)
        self._stem, self._stem_reads = self._loop_piece(STEM, pieces.stem, sample)
        self._tail, self._tail_reads = self._loop_piece(TAIL, pieces.tail, hidden)
        first = blocks = [self._loop_piece(BLOCKS, piece, hidden) for piece in pieces.blocks]
        if parts.first is not parts.weights:
            first = [self._loop_piece(BLOCKS, piece, hidden, parts.first) for piece in pieces.blocks]
        self._blocks, self._block_reads = zip(*blocks, strict=True)
        self._first, _ = zip(*first, strict=True)
        self._pruner = None
        if pieces.pruner is not None:
            self._pruner_reads = [self.contexts.values[name] for name in pieces.pruner.inputs]
            self._pruner = self._written(PRUNER, pieces.pruner, self._pruner_reads, streams)
        self._contiguous = self._stem(sample, *self._stem_reads[0])[0].is_contiguous()

    def prologue(self) -> None:
        """Everything that the observation decides before the loop."""
        self.contexts.keep(once_values(self._parts.pieces, self._run_once, self._obs).items())
        step = self._parts.pieces.step
        if self._step is not None and step is not None:
            made = self._step(*self.contexts.for_step_piece(step.inputs))
            self.contexts.keep_steps(zip(step.outputs, made, strict=True))

    def _write_and_run(self, name: str, given: Mapping[str, Tensor]) -> Sequence[Tensor]:
        graph = self._parts.pieces.once()[name]
        rows = self.streams if name in (FRAMES, SCENE, CONDITION) else len(next(iter(given.values())))
        self._once[name] = self._written(name, graph, list(given.values()), rows, list(given))
        return self._run_once(name, given)

    def _run_once(self, name: str, given: Mapping[str, Tensor]) -> Sequence[Tensor]:
        made, narrow = self._once[name](*given.values()), self._parts.narrow.get(name)  # others may read it in fp32
        return made if narrow is None else [each.float() if each.dtype == narrow else each for each in made]

    def condition(self) -> Tensor:
        """What a correction reads: the features, one row of numbers a stream, ``[B, N]``."""
        features: Tensor = self.contexts.features()
        return features

    def logits(self) -> Tensor:
        """The pruner, float32 ``[B, K, blocks, 4]``."""
        assert self._pruner is not None  # asked for only if there is one
        return self._pruner(*self._pruner_reads)[0]

    def stem(self, sample: Tensor, k: int) -> Tensor:
        hidden = self._stem(sample, *self._stem_reads[k])[0]
        return hidden if self._contiguous else hidden.contiguous()

    def block(self, b: int, k: int, hidden: Tensor) -> Tensor:
        residual: Tensor = (self._blocks if k else self._first)[b](hidden, *self._block_reads[b][k])[0]
        return residual

    def tail(self, hidden: Tensor, k: int) -> Tensor:
        return self._tail(hidden, *self._tail_reads[k])[0]

    def _written(  # a graph, and all that its function depends on
        self,
        part: str,
        graph: Graph,
        examples: Sequence[Tensor],
        streams: int,
        order: Sequence[str] | None = None,
        weights: Mapping[str, Tensor] | None = None,
    ) -> Function:
        if order is not None:  # of the parameters; those that the graph does not read are there too
            types = {name: graph.inputs.get(name, TensorType((), "float32")) for name in order}
            graph = Graph(types, graph.constants, graph.nodes, graph.outputs)
        kind, narrow = self._parts.device.type, self._parts.narrow.get(part)
        with nullcontext() if narrow is None else torch.autocast(kind, narrow, cache_enabled=False):
            function = write_function(graph, weights or self._parts.weights, examples, streams, narrow)
        if narrow is None:
            return function

        def narrowed(*given: Tensor) -> tuple[Tensor, ...]:
            with torch.autocast(kind, narrow, cache_enabled=False):
                return function(*given)

        return narrowed

    def _loop_piece(
        self, part: str, piece: LoopPiece, value: Tensor, weights: Mapping[str, Tensor] | None = None
    ) -> tuple[Function, list[tuple[Tensor, ...]]]:
        """The function of a piece, with the residual stream first, and its contexts at each step."""
        contexts = list(piece.contexts)
        reads = [tuple(self.contexts.at(name, k) for name in contexts) for k in range(self._steps)]
        order = [piece.stream, *contexts]
        return self._written(part, piece.graph, [value, *reads[0]], self.streams, order, weights), reads
