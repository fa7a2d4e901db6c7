"""Sparse calls whose gates have gradients: what training the plan head needs, at the price of the sparse calls.

A gate's gradient is the product of what it would add and the gradient of the sum (``runtimes.reference.reuse``). For
FORWARD, TIMESTEP and ROLLOUT that is in the caches. For a cell that is not computed, what its block would compute is
taken from the dense call with the same noise, which is known: it costs nothing, does not depend on the plan so far, and
is what the sparse call should come to. So an update computes the cells of its plans, and no others.
"""

import math

import numpy as np
import torch
from torch import Tensor

from ...core.lattice import BoolArray, PlanArray, Source
from ...runtimes.reference.reuse import Caches, Cell, reuse
from ..calls import Calls, IntArray
from ..runner import Runner, StreamCaches, latest_before

BYTES = 2**28
"""Memory for what the blocks compute in the dense calls, as bfloat16. It decides how many calls are learned from."""


class Practice:
    """Calls to learn from, in windows of consecutive ones, and what the blocks compute in them when all is computed."""

    def __init__(self, runner: Runner, calls: Calls) -> None:
        model = runner.model
        each = 2 * model.steps * sum(math.prod(type_.at(1)) for type_ in runner.types) * calls.window
        windows = min(calls.count // calls.window, max(1, BYTES // each))
        self._runner = runner
        self.calls = runner.select(calls, np.arange(windows * calls.window))
        self._dense: list[list[Tensor]] = []
        caches, whole = StreamCaches(), np.full((1, model.blocks), Source.COMPUTE, np.int8)

        def blocks(k: int, stem: Tensor) -> Tensor:
            stream = runner.step(whole, k, stem, self.calls, caches)
            self._dense.append([caches.timestep[b].to(torch.bfloat16) for b in range(model.blocks)])
            return stream

        with torch.no_grad():
            for _ in runner.corrected(None).samples(self.calls, blocks):
                pass

    def samples(self, plans: PlanArray, gates: Tensor, numbers: IntArray) -> list[Tensor]:
        """The sample after each step, ``[N, T, D]`` each, with gradients of the gates.

        Args:
            plans: legal, int8 ``[N, K, blocks]``, step 0 dense.
            gates: the same one-hot, ``[N, K, blocks, 4]``.
            numbers: of N of the calls, whole windows.
        """
        runner, model, caches = self._runner, self._runner.model, Caches({})
        calls, there = runner.select(self.calls, numbers), torch.from_numpy(numbers)
        gates = gates.to(model.device)

        def blocks(k: int, stream: Tensor) -> Tensor:
            for b, axis in enumerate(runner.axes):
                column = plans[:, k, b]
                computed = self._dense[k][b].index_select(axis, there.to(stream.device)).to(stream.dtype)
                takers = np.flatnonzero(column == Source.COMPUTE)
                if len(takers):
                    own = takers.tolist() if len(takers) < calls.contexts.streams else None
                    part = model.block(b, k, stream, calls.contexts, own)
                    computed = computed.index_copy(axis, torch.from_numpy(takers).to(stream.device), part)
                if (before := _earlier(column, computed.detach(), axis, calls.window)) is not None:
                    caches.rollout[k, b] = before
                cell = Cell(k, b, model.groups[b], column, gates[:, k, b], runner.types[b])
                stream = stream + reuse(cell, computed, caches)
                caches.rollout.pop((k, b), None)  # nobody reads it after this cell
            return stream

        return list(runner.samples(calls, blocks))


def legal(wished: PlanArray, window: int) -> PlanArray:
    """Plans ``[N, K, blocks]`` of calls in windows as a runtime executes them: TIMESTEP for an unwritten ROLLOUT."""
    plans = wished.copy()
    plans[:, 0] = Source.COMPUTE
    plans[(plans == Source.ROLLOUT) & ~written(plans, window)] = Source.TIMESTEP
    return plans


def written(plans: PlanArray, window: int) -> BoolArray:
    """Which cells an earlier call of its window computed, bool ``[N, K, blocks]``."""
    return np.asarray(latest_before(plans, window) >= 0)


def _earlier(column: PlanArray, computed: Tensor, axis: int, window: int) -> Tensor | None:
    """For each call what the last earlier one of its window computed; rubbish where none did. None if none did at all.

    Every call is asked, not only those that read it: the gate of ROLLOUT has a gradient in all of them.
    """
    latest = latest_before(column, window)
    if (latest < 0).all():
        return None
    return computed.index_select(axis, torch.from_numpy(np.maximum(latest, 0)).to(computed.device))
