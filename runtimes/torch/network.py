"""The network of an artifact on a device: its constants, and what each piece computes for one number of streams."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ttscompile.artifact.view import View
from ttscompile.errors import ArtifactError
from ttscompile.ir.graph import Graph, TensorType
from ttscompile.ir.idle_form import idle_form
from ttscompile.ir.pieces import FRAMES, LoopPiece
from ttscompile.ir.program import Binding, frame_values

from . import devices
from .functions import Function, write_function
from .idle_steps import IdleSteps

Array: TypeAlias = npt.NDArray[np.generic]


class Placed:
    """Arrays of an artifact on a device, each once."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._known: dict[int, tuple[Array, Tensor]] = {}  # by identity, which the entry keeps from reuse

    def all(self, arrays: Mapping[str, Array]) -> dict[str, Tensor]:
        """The tensors of these arrays, by name."""
        for array in arrays.values():
            if id(array) not in self._known:
                self._known[id(array)] = array, devices.placed(array, self.device)
        return {name: self._known[id(array)][1] for name, array in arrays.items()}


class Parts:
    """What all numbers of streams share."""

    def __init__(self, view: View, placed: Placed, narrow: torch.dtype | None) -> None:
        self.manifest, self.pieces = view.manifest, view.pieces
        self.device, self.narrow = placed.device, narrow
        values = {**view.weights, **view.pruner}
        self.weights = placed.all(values)
        first = placed.all(view.first_weights)
        self.first = self.weights | first if first else self.weights
        form, _ = idle_form(self.pieces, values)
        self.idle = None if form is None else IdleSteps(form, placed.device)

    def tensor(self, kind: TensorType, streams: int, *before: int) -> Tensor:
        """Zeros of a type, with other axes before its own."""
        return torch.zeros((*before, *kind.at(streams)), dtype=getattr(torch, kind.dtype), device=self.device)


class StreamsNetwork:
    """The pieces for B streams, and the contexts that they read, which stay where they are.

    Args:
        parts: of the artifact.
        obs: what the prologue reads: observations by key, ``[B, ...]`` each.
        streams: B.

    Attributes:
        idle: see ``loop.Network``.
        values: contexts by name; those that differ from step to step ``[K, ...]``.
    """

    def __init__(self, parts: Parts, obs: Mapping[str, Tensor], streams: int) -> None:
        self._parts, self._obs, self.streams = parts, obs, streams
        manifest, pieces = parts.manifest, parts.pieces
        self._steps, self.idle = manifest.steps, parts.idle
        self.values: dict[str, Tensor] = {}
        for name, context in manifest.contexts.items():
            before = () if context.binding is Binding.CONDITION else (self._steps,)
            self.values[name] = parts.tensor(context.type, streams, *before)
            if context.binding is Binding.TABLE:  # one row of a batch of one, for all streams
                self.values[name].copy_(devices.placed(pieces.tables[name], parts.device))
        self._once: dict[str, Function] = {}
        seen = frame_values(pieces, self._write_and_run, obs)
        order = [*obs, *seen]
        self._condition = self._written(pieces.condition, [*obs.values(), *seen.values()], streams, order=order)
        self._step: Function | None = None
        self.prologue()
        if pieces.step is not None:
            self._step = self._written(pieces.step, self._step_inputs(pieces.step), self._steps * streams)
            self.prologue()
        (horizon, dimensions), kind = manifest.spec.sample, manifest.blocks[0].type
        sample = torch.zeros((dimensions, streams, horizon), device=parts.device).permute(1, 2, 0)
        stream = parts.tensor(kind, streams)
        self._stem, self._stem_reads = self._loop_piece(pieces.stem, sample)
        self._tail, self._tail_reads = self._loop_piece(pieces.tail, stream)
        with self._narrow():
            blocks = [self._loop_piece(piece, stream, parts.narrow) for piece in pieces.blocks]
            first = blocks
            if parts.first is not parts.weights:
                first = [self._loop_piece(piece, stream, parts.narrow, parts.first) for piece in pieces.blocks]
        self._blocks, self._block_reads = zip(*blocks, strict=True)
        self._first, _ = zip(*first, strict=True)
        self._pruner = None
        if pieces.pruner is not None:
            self._pruner_reads = [self.values[name] for name in pieces.pruner.inputs]
            self._pruner = self._written(pieces.pruner, self._pruner_reads, streams)
        self._contiguous = self._stem(sample, *self._stem_reads[0])[0].is_contiguous()

    def prologue(self) -> None:
        """Everything that the observation decides before the loop."""
        seen = frame_values(self._parts.pieces, self._run_once, self._obs)
        made = self._condition(*self._obs.values(), *seen.values())
        for name, value in zip(self._parts.pieces.condition.outputs, made, strict=True):
            if name in self.values:  # a network that ignores the condition has values that nobody reads
                self.values[name].copy_(value)
        step = self._parts.pieces.step
        if self._step is None or step is None:
            return
        for name, value in zip(step.outputs, self._step(*self._step_inputs(step)), strict=True):
            axis = self._axis(name)
            front = value.movedim(axis, 0)  # from [..., K * B, ...] to [K, ..., B, ...]
            split = front.reshape(self._steps, self.streams, *front.shape[1:])
            self.values[name].copy_(split.movedim(1, axis + 1))

    def _write_and_run(self, name: str, given: Mapping[str, Tensor]) -> Sequence[Tensor]:
        graph = self._parts.pieces.once()[name]
        rows = self.streams if name == FRAMES else len(next(iter(given.values())))
        self._once[name] = self._written(graph, list(given.values()), rows, order=list(given))
        return self._run_once(name, given)

    def _run_once(self, name: str, given: Mapping[str, Tensor]) -> Sequence[Tensor]:
        return self._once[name](*given.values())

    def condition(self) -> Tensor:
        """What a correction reads: the features, one row of numbers a stream, ``[B, N]``."""
        contexts = self._parts.manifest.contexts
        rows = [self.values[n].movedim(contexts[n].type.batch_axis or 0, 0) for n in self._parts.manifest.features]
        return torch.cat([row.reshape(self.streams, -1) for row in rows], 1)

    def logits(self) -> Tensor:
        """The pruner, float32 ``[B, K, blocks, 4]``."""
        assert self._pruner is not None  # asked for only if there is one
        return self._pruner(*self._pruner_reads)[0]

    def stem(self, sample: Tensor, k: int) -> Tensor:
        """See ``loop.Network``."""
        stream = self._stem(sample, *self._stem_reads[k])[0]
        return stream if self._contiguous else stream.contiguous()

    def block(self, b: int, k: int, stream: Tensor) -> Tensor:
        """See ``loop.Network``."""
        block = self._blocks[b] if k else self._first[b]
        if self._parts.narrow is None:
            residual: Tensor = block(stream, *self._block_reads[b][k])[0]
            return residual
        with self._narrow():
            residual = block(stream, *self._block_reads[b][k])[0]
            return residual

    def tail(self, stream: Tensor, k: int) -> Tensor:
        """See ``loop.Network``."""
        return self._tail(stream, *self._tail_reads[k])[0]

    def take(self, other: StreamsNetwork, index: Tensor) -> None:
        """The contexts of some streams of another network."""
        for name, context in self._parts.manifest.contexts.items():
            axis = context.type.batch_axis
            if context.binding is Binding.TABLE:
                continue
            if axis is not None:
                before = context.binding is not Binding.CONDITION
                self.values[name].copy_(other.values[name].index_select(axis + before, index))
            else:
                self.values[name].copy_(other.values[name])

    def _narrow(self) -> AbstractContextManager[object]:
        parts = self._parts
        if parts.narrow is None:
            return nullcontext()
        return torch.autocast(parts.device.type, parts.narrow, cache_enabled=False)

    def _written(
        self,
        graph: Graph,
        examples: Sequence[Tensor],
        streams: int,
        narrow: torch.dtype | None = None,
        order: Sequence[str] | None = None,
        weights: Mapping[str, Tensor] | None = None,
    ) -> Function:
        if order is not None:  # of the parameters; those that the graph does not read are there too
            types = {name: graph.inputs.get(name, TensorType((), "float32")) for name in order}
            graph = Graph(types, graph.constants, graph.nodes, graph.outputs)
        return write_function(graph, weights or self._parts.weights, examples, streams, narrow)

    def _loop_piece(
        self,
        piece: LoopPiece,
        value: Tensor,
        narrow: torch.dtype | None = None,
        weights: Mapping[str, Tensor] | None = None,
    ) -> tuple[Function, list[tuple[Tensor, ...]]]:
        """The function of a piece, with the stream first, and its contexts at each step."""
        contexts = list(piece.contexts)
        reads = [tuple(self._at(name, k) for name in contexts) for k in range(self._steps)]
        order = [piece.stream, *contexts]
        return self._written(piece.graph, [value, *reads[0]], self.streams, narrow, order, weights), reads

    def _at(self, name: str, k: int) -> Tensor:
        stepwise = self._parts.manifest.contexts[name].binding is not Binding.CONDITION
        return self.values[name][k] if stepwise else self.values[name]

    def _step_inputs(self, graph: Graph) -> list[Tensor]:
        """What the step piece reads, with a batch of K * B, step-major."""
        found = []
        for name in graph.inputs:
            context, value = self._parts.manifest.contexts[name], self.values[name]
            if context.binding is not Binding.CONDITION:
                found.append(torch.cat(list(value), self._axis(name)))
            elif context.type.batch_axis is None:
                found.append(value)
            else:
                found.append(torch.cat([value] * self._steps, context.type.batch_axis))
        return found

    def _axis(self, name: str) -> int:
        axis = self._parts.manifest.contexts[name].type.batch_axis
        if axis is None:
            problem = f"step value {name!r} has no axis for the streams"
            raise ArtifactError(f"{problem}. Convert the checkpoint again.")
        return axis
