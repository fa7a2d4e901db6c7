"""Plans on many calls at once: the meaning of the reference runtime for calls that are independent of each other.

A search tries thousands of plans, on calls that go through the loop together; a step in which nothing is computed costs
one addition. No plan here reads the rollout cache: what one call leaves for the next is the reference runtime's
business. Tests hold this against ``ReferenceModel.rollout``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import copy
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..artifact.load import Artifact
from ..core.correction import Correction
from ..core.lattice import BoolArray, PlanArray, Source, dense_plan
from ..errors import IllegalPlanError
from ..runtimes.reference.model import ReferenceModel
from ..runtimes.reference.sampler import Carried
from .calls import Calls, Selector

STREAMS = 256
"""Calls with plans of their own that go through the loop at once."""


class Executor:
    """Runs plans without gradients.

    Args:
        artifact: the policy.

    Attributes:
        correction: of the sampler's steps, for all that is run but ``run_dense``; None for none.
        model: of the policy.
        selector: takes calls apart.
        types: of each block's residual.
        axes: of the streams in each block's residual.
        alike: whether all blocks have residuals of one type.
        pruner_graph: the pruner; None if the artifact has none.
    """

    def __init__(self, artifact: Artifact) -> None:
        blocks = artifact.manifest.blocks
        self.model = ReferenceModel.from_artifact(artifact)
        pieces = artifact.pieces
        self.selector = Selector(graph for graph in (pieces.condition, pieces.step) if graph is not None)
        self.types = [block.type for block in blocks]
        self.axes = [block.type.batch_axis or 0 for block in blocks]
        self.alike = len({block.type for block in blocks}) == 1
        self.pruner_graph = pieces.pruner
        self.correction: Correction | None = None

    def corrected(self, correction: Correction | None) -> Executor:
        """The same executor with another correction, or none."""
        other = copy(self)
        other.correction = correction
        return other

    def run(self, plan: PlanArray, calls: Calls) -> Tensor:
        """The denoised sample of every call.

        Args:
            plan: ``[K, blocks]``, or ``[N, K, blocks]`` for each call one of its own; legal without a rollout cache.
            calls: N of them.

        Returns:
            ``[N, T, D]``.

        Raises:
            IllegalPlanError: a plan reads the rollout cache, or step 0 is not dense.
        """
        if (plan == Source.ROLLOUT).any() or (plan[..., 0, :] != Source.COMPUTE).any():
            raise IllegalPlanError("expected plans with a dense step 0 that read nothing of an earlier call.")
        with torch.no_grad():
            if plan.ndim == 2:
                return self._loop(plan[None], calls)
            parts = [np.arange(i, min(i + STREAMS, len(plan))) for i in range(0, len(plan), STREAMS)]
            return torch.cat([self._loop(plan[part], self.selector.calls(calls, part)) for part in parts])

    def run_dense(self, calls: Calls) -> Tensor:
        """What the dense policy answers, and how it gets there: the sample after each step, ``[N, K, T, D]``."""
        path: list[Tensor] = []
        with torch.no_grad():
            self.corrected(None)._loop(dense_plan(self.model.steps, self.model.blocks)[None], calls, path)
        return torch.stack(path, 1)

    @torch.no_grad()
    def dense_steps(self, calls: Calls) -> Iterator[tuple[Tensor, list[Tensor]]]:
        """Step by step, the stream after the stem of dense calls, and what each block adds to it."""
        dense, carried = self.corrected(None), self.model.begin(calls.initial)
        for k in range(self.model.steps):
            stem = stream = self.model.stem(carried.sample, k, calls.contexts)
            residuals = []
            for b in range(self.model.blocks):
                residuals.append(self.model.block(b, k, stream, calls.contexts))
                stream = stream + residuals[-1]
            yield stem, residuals
            carried = dense.advance(carried, self.model.tail(stream, k, calls.contexts), calls, k)

    def logits(self, calls: Calls, weights: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.float32]:
        """What the pruner says with these constants, ``[N, K, blocks, 4]``."""
        tensors = {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
        with torch.no_grad():
            return np.asarray(self.model.logits(calls.contexts, tensors).numpy(), dtype=np.float32)

    def _loop(self, plans: PlanArray, calls: Calls, path: list[Tensor] | None = None) -> Tensor:
        """All steps, with one plan for all calls or one for each; the sample after each goes to ``path``."""
        state, carried = State(len(self.axes)), self.model.begin(calls.initial)
        total: Tensor | None = None  # what all blocks add together, as long as nothing is computed
        previous: PlanArray | None = None
        for k in range(self.model.steps):
            row = plans[:, k]
            stem = self.model.stem(carried.sample, k, calls.contexts)
            if total is not None and previous is not None and np.array_equal(row, previous):
                stream = stem + total
            else:
                stream = self.step(row, k, stem, calls, state)
                computes = bool((row == Source.COMPUTE).any())
                total = None if computes or not self.alike else stream - stem
                previous = None if computes else row
            prediction = self.model.tail(stream, k, calls.contexts)
            carried = self.advance(carried, prediction, calls, k)
            if path is not None:
                path.append(carried.sample)
        return carried.sample

    def advance(self, carried: Carried, prediction: Tensor, calls: Calls, k: int) -> Carried:
        """What the sampler carries to step k + 1."""
        noise = None if calls.noise is None else calls.noise[k]
        return self.model.advance(carried, prediction, noise, k, self.correction)

    def step(self, row: PlanArray, k: int, stream: Tensor, calls: Calls, state: State) -> Tensor:
        """All blocks of one step, where ``row [1, blocks]`` or ``[N, blocks]`` says what to do."""
        for b, axis in enumerate(self.axes):
            group, column = self.model.groups[b], row[:, b]
            computing, forwarding = column == Source.COMPUTE, column == Source.FORWARD
            if computing.all():
                residual = self.model.block(b, k, stream, calls.contexts)
                state.timestep[b] = state.forward[group] = residual
            else:
                residual = state.reused(b, group, forwarding, axis)
                if computing.any():
                    streams = _numbers(computing)
                    part = self.model.block(b, k, stream, calls.contexts, streams.tolist())
                    residual = residual.index_copy(axis, streams, part)
                    state.write(b, group, axis, streams, part)
            stream = stream + residual
        return stream


class State:
    """Caches of all streams, before step 0.

    Args:
        blocks: number of residual blocks.
    """

    def __init__(self, blocks: int) -> None:
        self.forward: dict[int, Tensor] = {}
        self.timestep: list[Tensor | None] = [None] * blocks

    def reused(self, b: int, group: int, forwarding: BoolArray, axis: int) -> Tensor:
        """What block b adds where it is not computed."""
        own, other = self.timestep[b], self.forward[group]
        assert own is not None  # step 0 is dense
        if not forwarding.any():
            return own
        if forwarding.all():
            return other
        streams = _numbers(forwarding)
        return own.index_copy(axis, streams, other.index_select(axis, streams))

    def write(self, b: int, group: int, axis: int, streams: Tensor, residual: Tensor) -> None:
        """Put computed residuals of some streams into the caches."""
        own = self.timestep[b]
        assert own is not None
        self.timestep[b] = own.index_copy(axis, streams, residual)
        self.forward[group] = self.forward[group].index_copy(axis, streams, residual)


def _numbers(streams: BoolArray) -> Tensor:
    """Numbers of those streams that are True."""
    return torch.from_numpy(np.flatnonzero(streams))
