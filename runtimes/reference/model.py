"""The reference: what reuse means, executed literally with torch, one block after the other, differentiable.

``docs/design.md`` section 2 in code; what one cell does is in ``reuse``. Every other runtime is tested
against this one, and calibration trains through it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ttscompile.artifact.view import View
from ttscompile.core.coercion import Array, Arrays
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import Source, check_plan, require_legal
from ttscompile.core.spec import Noise, PolicySpec
from ttscompile.errors import IllegalPlanError
from ttscompile.ir.evaluate import Evaluator
from ttscompile.ir.graph import TensorType, backward_slice
from ttscompile.ir.pieces import LoopPiece
from ttscompile.ir.program import Binding, Pieces, once_values
from ttscompile.runtimes.inpainting import Known

from .reuse import Caches, Cell, RolloutCache, reuse, stream_axis
from .sampler import Carried, TorchSampler, hold


@dataclass(frozen=True)
class Contexts:
    """What the observation decides before the loop. Step values are made of it when a piece reads them.

    Kept for all steps, those of a modulated network would be megabytes a call.
    """

    streams: int
    condition: Mapping[str, Tensor]


Blocks = Callable[[int, Tensor], Tensor]
"""From a step and the residual stream after its stem to the residual stream after its last block."""


@dataclass(frozen=True)
class Denoised:
    """Result of one call; ``samples`` are those ``[B, T, D]`` after each of the K steps."""

    samples: tuple[Tensor, ...]
    cache: RolloutCache

    @property
    def sample(self) -> Tensor:
        """The denoised sample ``[B, T, D]``."""
        return self.samples[-1]


class ReferenceModel:
    """The pieces of a program as torch functions, and the denoising loop over them.

    Weights are held by reference: an in-place update of ``weights`` (the pruner's, by an optimiser) shows in the next
    call.

    Args:
        pieces: the denoiser cut up; the pruner may be missing.
        weights: value of every constant of the pieces.
        device: where the pieces compute. Samples, and what the sampler does with them, are on the CPU wherever that is.
        first: values of constants that blocks have at step 0, where those are others.

    Attributes:
        weights: every constant by name; at step 0 blocks may have others (``first``).
    """

    def __init__(
        self,
        pieces: Pieces,
        spec: PolicySpec,
        types: Sequence[TensorType],
        groups: Sequence[int],
        weights: Arrays,
        device: torch.device | None = None,
        first: Arrays = MappingProxyType({}),
    ) -> None:
        self.device = torch.device("cpu") if device is None else device
        self._pieces, self._types, self.sampler = pieces, tuple(types), TorchSampler(spec.sampler)
        self._committed = spec.committed
        self.weights = {name: _tensor(value).to(self.device) for name, value in weights.items()}
        self._tables = {name: _tensor(value).to(self.device) for name, value in self._pieces.tables.items()}
        evaluator = partial(Evaluator, weights=self.weights, device=self.device)
        self._once = {name: evaluator(graph) for name, graph in pieces.once().items()}
        self._steps: dict[tuple[str, ...], tuple[Mapping[str, TensorType], Evaluator]] = {}
        for piece in (pieces.stem, *pieces.blocks, pieces.tail):
            if pieces.step is not None and (made := self._of_steps(piece.contexts)):
                graph = backward_slice(pieces.step, made, {})
                self._steps[made] = graph.inputs, evaluator(graph)
        self._stem = evaluator(pieces.stem.graph)
        self._blocks = self._first = tuple(evaluator(piece.graph) for piece in pieces.blocks)
        if first:
            own = {**self.weights, **{name: _tensor(value).to(self.device) for name, value in first.items()}}
            self._first = tuple(Evaluator(piece.graph, own, self.device) for piece in pieces.blocks)
        self._tail = evaluator(pieces.tail.graph)
        self.steps = spec.sampler.steps
        self.blocks = len(self._pieces.blocks)
        self.groups = tuple(groups)

    @classmethod
    def from_view(cls, view: View, device: torch.device | None = None) -> ReferenceModel:
        """The model of a view of an artifact, in fp32, on a device; None for the CPU."""
        manifest, weights = view.manifest, {**view.weights, **view.pruner}
        types = [block.type for block in manifest.blocks]
        return cls(view.pieces, manifest.spec, types, manifest.groups, weights, device, view.first_weights)

    def prologue(self, obs: Mapping[str, Tensor]) -> Contexts:
        """What normalised observations ``[B, ...]`` decide before the loop; none are committed unless they say so."""
        streams = len(next(iter(obs.values())))
        uncommitted = {key: _tensor(count) for key, count in self._committed(streams).items()}
        there = {key: value.to(self.device) for key, value in (uncommitted | dict(obs)).items()}
        made = once_values(self._pieces, lambda name, given: self._once[name](given), there)
        return Contexts(streams, {name: made[name] for name in self._pieces.conditions})

    def joined(self, parts: Iterable[Contexts], streams: int) -> Contexts:
        """What the loop reads for several batches of streams, as for one batch of all of them."""
        axes = {name: one.batch_axis for name, one in self._pieces.conditions.items()}
        whole, begin = dict[str, Tensor](), 0
        for part in parts:
            for name, value in part.condition.items():
                if (axis := axes[name]) is None:
                    whole[name] = value
                    continue
                if name not in whole:
                    whole[name] = value.new_empty([streams if i == axis else n for i, n in enumerate(value.shape)])
                whole[name].narrow(axis, begin, part.streams).copy_(value)
            begin += part.streams
        assert begin == streams
        return Contexts(streams, whole)

    def condition(self, contexts: Contexts) -> Tensor:
        """What a correction reads of the observation: the pruner's features, one row a stream, ``[B, N]``."""
        types = self._pieces.conditions
        own = [contexts.condition[name].cpu() for name in self._pieces.features]
        rows = [one.movedim(types[n].batch_axis or 0, 0) for one, n in zip(own, self._pieces.features, strict=True)]
        return torch.cat([torch.zeros(contexts.streams, 0), *(row.reshape(contexts.streams, -1) for row in rows)], 1)

    def logits(self, contexts: Contexts, weights: Mapping[str, Tensor] | None = None) -> Tensor:
        """The pruner: float32 ``[B, K, blocks, 4]``; with gradients for ``weights`` in place of its constants."""
        pruner = self._pieces.pruner
        if pruner is None:
            raise IllegalPlanError("the program has no pruner: run insert_pruner, or give a plan.")
        given = {name: value.to(self.device) for name, value in (weights or {}).items()}
        return Evaluator(pruner, {**self.weights, **given}, self.device)(contexts.condition)[0].cpu()

    def stem(self, sample: Tensor, k: int, contexts: Contexts) -> Tensor:
        """The residual stream of step k, on the device, from the sample ``[B, T, D]``."""
        return self._stem(self._bind(self._pieces.stem, sample.to(self.device), k, contexts))[0]

    def block(self, b: int, k: int, hidden: Tensor, contexts: Contexts, streams: Sequence[int] | None = None) -> Tensor:
        """The residual of block b at step k, for all ``streams`` or these: what is added, and not the sum."""
        blocks = self._blocks if k else self._first
        return blocks[b](self._bind(self._pieces.blocks[b], hidden, k, contexts, streams))[0]

    def tail(self, hidden: Tensor, k: int, contexts: Contexts) -> Tensor:
        """The network's output ``[B, T, D]`` at step k, on the CPU, from the residual stream after the last block."""
        return self._tail(self._bind(self._pieces.tail, hidden, k, contexts))[0].cpu()

    def predict(self, sample: Tensor, k: int, contexts: Contexts, blocks: Blocks) -> Tensor:
        """The network's output ``[B, T, D]`` at step k, from the sample ``[B, T, D]``."""
        return self.tail(blocks(k, self.stem(sample, k, contexts)), k, contexts)

    def empty_cache(self, streams: int) -> RolloutCache:
        """The rollout cache at the start of an episode."""
        return RolloutCache({}, np.zeros((streams, self.steps, self.blocks), dtype=np.bool_))

    def steps_of(
        self,
        contexts: Contexts,
        initial: Tensor,
        noise: Tensor | None,
        blocks: Blocks,
        correction: Correction | None = None,
        known: Known | None = None,
        since: tuple[int, Carried] | None = None,
    ) -> Iterator[Carried]:
        """The denoising loop, whatever the blocks do: what each step makes, before what is known takes its place.

        Args:
            contexts: from ``prologue``.
            initial: the sample at step 0, ``[B, T, D]``.
            noise: the draw used at each step, ``[K, B, T, D]``; None if the sampler is deterministic.
            blocks: asked once a step, in order.
            correction: of the sampler's steps; None for none.
            known: what a prefix makes known of the samples; None for nothing.
            since: a step to begin with, and what is carried to it; None for the whole loop.
        """
        begin, carried = (0, self.sampler.begin(initial)) if since is None else since
        condition = self.condition(contexts) if correction is not None and correction.reads else None
        for k in range(begin, self.steps):
            carried = hold(carried, known, k)
            prediction = self.predict(carried.sample, k, contexts, blocks)
            draw = None if noise is None else noise[k]
            carried = self.sampler.advance(carried, prediction, draw, k, correction, condition)
            yield carried

    def denoise(
        self,
        contexts: Contexts,
        initial: Tensor,
        noise: Tensor | None,
        plan: npt.ArrayLike,
        cache: RolloutCache | None = None,
        *,
        correction: Correction | None = None,
        known: Known | None = None,
    ) -> Denoised:
        """One call: K steps from noise to sample. A block is evaluated for the streams that compute it, and no others.

        The plan is int8 ``[K, blocks]`` or ``[B, K, blocks]``; ``cache`` is what the previous call of the episode left.

        Raises:
            IllegalPlanError: a plan of the wrong shape, or that reads what was never computed.
        """
        cache = cache if cache is not None else self.empty_cache(contexts.streams)
        plans = check_plan(plan, self.steps, self.blocks, contexts.streams)
        require_legal(plans, self.groups, cache.written)
        gates = torch.nn.functional.one_hot(torch.from_numpy(plans.astype(np.int64)), 4).float().to(self.device)
        caches = Caches(rollout=dict(cache.residuals))

        def blocks(k: int, hidden: Tensor) -> Tensor:
            for b in range(self.blocks):
                cell = Cell(k, b, self.groups[b], plans[:, k, b], gates[:, k, b], self._types[b])
                hidden = hidden + reuse(cell, self._computed(cell, hidden, contexts), caches)
            return hidden

        loop = self.steps_of(contexts, initial, noise, blocks, correction, known)
        samples = tuple(hold(carried, known, k).sample for k, carried in enumerate(loop, 1))
        return Denoised(samples, RolloutCache(caches.rollout, cache.written | (plans == Source.COMPUTE)))

    def _computed(self, cell: Cell, hidden: Tensor, contexts: Contexts) -> Tensor | None:
        """The residual of the streams that compute it, with zeros for the others; None if none do."""
        takers = np.flatnonzero(cell.plan == Source.COMPUTE).tolist()
        if len(takers) == len(cell.plan):
            return self.block(cell.b, cell.k, hidden, contexts)
        if not takers:
            return None
        part, there = self.block(cell.b, cell.k, hidden, contexts, takers), torch.tensor(takers, device=hidden.device)
        return torch.zeros_like(hidden).index_copy(stream_axis(cell.type), there, part)

    def _bind(
        self, piece: LoopPiece, value: Tensor, k: int, contexts: Contexts, streams: Sequence[int] | None = None
    ) -> dict[str, Tensor]:
        """The inputs of a loop piece at step k; of some streams only, if they are given."""
        hidden = {piece.stream: _select(value, piece.type, streams)}
        return hidden | self._contexts(piece.contexts, k, contexts, streams)

    def _contexts(
        self, types: Mapping[str, TensorType], k: int, contexts: Contexts, streams: Sequence[int] | None = None
    ) -> dict[str, Tensor]:
        bound: dict[str, Tensor] = {}
        if made := self._of_steps(types):
            inputs, evaluator = self._steps[made]
            bound |= zip(made, evaluator(self._contexts(inputs, k, contexts, streams)), strict=True)
        for name, kind in types.items():
            match self._pieces.bindings[name]:
                case Binding.TABLE:
                    row, axis = self._tables[name][k], kind.batch_axis
                    value = row.expand([contexts.streams if i == axis else n for i, n in enumerate(row.shape)])
                case Binding.CONDITION:
                    value = contexts.condition[name]
                case Binding.STEP:
                    continue
            bound[name] = _select(value, kind, streams)
        return bound

    def _of_steps(self, names: Iterable[str]) -> tuple[str, ...]:
        """Those of a piece's contexts that are made at each step."""
        return tuple(name for name in names if self._pieces.bindings[name] is Binding.STEP)


def noise_tensors(noise: Noise, stochastic: bool) -> tuple[Tensor, Tensor | None]:
    """Noise as ``ReferenceModel.denoise`` takes it, without the draws of the steps if the sampler uses none."""
    steps = _tensor(noise.steps) if stochastic and noise.steps is not None else None
    return _tensor(noise.initial), steps


def _tensor(array: Array) -> Tensor:
    """A copy as a tensor: arrays of an artifact are read-only, and torch has no such tensors."""
    return torch.from_numpy(np.array(array))


def _select(value: Tensor, kind: TensorType, streams: Sequence[int] | None) -> Tensor:
    if streams is None or kind.batch_axis is None:
        return value
    return value.index_select(kind.batch_axis, torch.tensor(streams, device=value.device))
