"""The denoising loop of one plan: a straight line of pure functions, the same for every batch, device and compiler.

Nothing here is written in place and nothing is read back, so a call can be captured in a CUDA graph, or exported.
Sample and what belongs to it have the action dimensions first, ``[D, B, T]``, as ``core.update`` wants them.
"""

from collections.abc import Container, Mapping, Sequence
from itertools import islice
from typing import Protocol

import torch
from torch import Tensor

from ttscompile.runtimes.instructions import Instructions

from .sampler import Advance, IdleSteps, State, begin


class Network(Protocol):
    """The pieces of the loop, for the observation at hand; ``idle`` is None where the network is of another form."""

    idle: IdleSteps | None

    def stem(self, sample: Tensor, k: int) -> Tensor:
        """The residual stream of step k from the sample ``[B, T, D]``."""

    def block(self, b: int, k: int, hidden: Tensor) -> Tensor:
        """The residual of block b at step k."""

    def tail(self, hidden: Tensor, k: int) -> Tensor:
        """The prediction ``[B, T, D]`` of step k from the residual stream after the last block."""


def denoise(  # noqa: PLR0913  # the tensors of a call, each by its name
    network: Network,
    plan: Instructions,
    keep: Container[int],
    advance: Advance,
    initial: Tensor,
    offset: Sequence[Tensor],
    rollout: Mapping[int, Tensor],
    read: Tensor | None,
    free: Tensor | None = None,
) -> tuple[Tensor, dict[int, Tensor]]:
    """All steps of a call in which every stream follows one plan.

    Args:
        network: of the call.
        plan: lowered.
        keep: flat indices of the computed residuals that the result holds.
        advance: the sampler.
        initial: the sample at step 0, ``[B, T, D]``.
        offset: what each step adds to the sample, K of ``[D, B, (1 + S) T]``.
        rollout: entries of the rollout cache that the plan reads, by flat index.
        read: what the correction reads of the condition, ``[B, F]``; None if it reads nothing.
        free: ``[D, 1, T]``, 0 for what a prefix makes known and 1 elsewhere; None without a prefix.

    Returns:
        The sample ``[B, T, D]``, and the residuals that were to be kept, by flat index ``k * blocks + b``.
    """
    offset = list(offset)

    def go_on(state: State, prediction: Tensor, k: int) -> State:
        """Step k; what its jump adds where the steps after it end is known now."""
        state = advance(state, prediction, k, offset[k])
        if k in advance.jumps:
            number, landing = advance.jumps[k]
            added = advance.jump([layer[number] for layer in advance.layers], read, state.history)
            added = added if free is None else added * free
            offset[landing] = offset[landing] + torch.nn.functional.pad(added, (0, advance.memories * advance.horizon))
        return state

    steps, blocks = plan.computed.shape
    residuals: dict[int, Tensor] = {}  # spelt so that torch.export can follow
    state = begin(initial, advance)
    operands, cells, k = _Operands(plan, blocks, rollout), iter(plan.cells), 0
    while k < steps:
        if network.idle is not None and plan.idle[k]:
            count = plan.alike[k]
            known, fused = network.idle.prepare(operands.total(count)), network.idle.fused
            if fused is not None and fused.fits(advance, k, count):
                state = fused.run(network.idle, known, advance, state, k, offset[k : k + count])
            else:
                for step in range(k, k + count):
                    state = go_on(state, network.idle.predict(known, state.sample), step)
            k += count
            continue
        first = hidden = network.stem(state.sample.permute(1, 2, 0), k)
        reached, operands.whole = 0, None if plan.counts[k] else operands.whole
        for cell in islice(cells, plan.counts[k]):
            b = cell - k * blocks
            if b != reached:
                hidden = hidden + operands.total()
            residual = operands.current[b] = network.block(b, k, hidden)
            hidden, reached = hidden + residual, b + 1
            if cell in keep:
                residuals[cell] = residual
        if reached != blocks:
            hidden = hidden + operands.total()
        if plan.counts[k] == blocks:
            operands.whole = hidden - first
        prediction = network.tail(hidden, k).permute(2, 0, 1)
        state = go_on(state, prediction, k)
        k += 1
    return state.sample.permute(1, 2, 0), residuals


class _Operands:
    """What each block computed last, for the instructions of a plan; and the sum of all, where it is known."""

    def __init__(self, plan: Instructions, blocks: int, rollout: Mapping[int, Tensor]) -> None:
        nothing = torch.zeros(0)  # step 0 computes all blocks before anything is read
        self.current, self._table = [nothing] * blocks, [nothing] * blocks
        self.whole: Tensor | None = None
        self._summed = self._table if plan.table else self.current
        self._sums = [nothing] * plan.slots
        self._gaps, self._loads = iter(plan.gaps), zip(plan.load_rows, plan.load_from, strict=True)
        self._rollout = rollout

    def total(self, alike: int = 1) -> Tensor:
        """The sum of the next gaps, so many of which add the same one; it is made first if it is new."""
        slot, start, stop, loads = next(self._gaps)
        for _ in islice(self._gaps, alike - 1):
            pass
        if start != stop:
            for row, source in islice(self._loads, loads):
                self._table[row] = self.current[~source] if source < 0 else self._rollout[source]
            several = self._summed[start:stop]
            if self.whole is not None and len(several) == len(self.current) and self._summed is self.current:
                several = [self.whole]
            self._sums[slot] = torch.stack(several).sum(0) if len(several) > 1 else several[0]
        return self._sums[slot]
