"""The denoising loop of a plan that only the program knows: for plans that the pruner makes, once they are exported.

    while k < K:                                                           while_loop
        hidden = stem(sample)
        for each block:
            residual = block(hidden), if any stream computes it            cond
                       what the plan says otherwise, without evaluating it
            hidden += residual
        sample = the sampler's step of tail(hidden)

It is in the program once, with every block once, whatever K is. A block is evaluated for all streams if one of them
computes it; the others then take what they reuse.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch._higher_order_ops.while_loop import while_loop  # torch has no public name for it

from ttscompile.core.correction import Correction
from ttscompile.core.lattice import Source
from ttscompile.core.spec import PolicySpec
from ttscompile.ir.pieces import STEM, TAIL, block_name

from .plain_network import PlainNetwork
from .sampler import Advance, State, begin


class SteppedAdvance(Advance):
    """The same, also at a step that only the program knows."""

    TENSORS = (*Advance.TENSORS, "remember", "number")

    def __init__(self, spec: PolicySpec, correction: Correction | None, device: torch.device) -> None:
        super().__init__(spec, correction, device)
        number = np.full(self.steps, -1, np.int64)
        for each, landing in self.jumps.values():
            number[landing] = each
        self.remember = torch.tensor(self.anchors, device=device)
        self.number = torch.tensor(number, device=device)

    def at(self, state: State, prediction: Tensor, k: Tensor, offset: Tensor) -> State:
        """What is carried to the step after k, which is int64 ``[1]``."""
        clean = None
        if self.clip is not None:
            of_sample, of_prediction = self.to_clean.index_select(0, k)[0].unbind()
            clean = (state.sample * of_sample + prediction * of_prediction).clamp(-self.clip, self.clip)
        matrix = self.updates.index_select(0, k)[0].expand(len(state.sample), -1, -1)
        moved = self._moved(state, prediction, clean, matrix, offset)
        anchor = self.remember.index_select(0, k)
        return moved._replace(history=torch.where(anchor, self._longer(state, prediction), state.history))

    def jumped(self, k: Tensor, offset: Tensor, read: Tensor | None, history: Tensor) -> Tensor:
        """The offset of step k, with the jump that ends there if one does."""
        if not self.layers:
            return offset
        number = self.number.index_select(0, k)

        def jump() -> Tensor:
            added = self.jump([layer.index_select(0, number)[0] for layer in self.layers], read, history)
            return offset + torch.nn.functional.pad(added, (0, self.memories * self.horizon))

        return either((number >= 0)[0], jump, offset)


def denoise_as_planned(
    network: PlainNetwork,
    groups: Sequence[int],
    plan: Tensor,
    advance: SteppedAdvance,
    initial: Tensor,
    offset: Tensor,
    read: Tensor | None,
    rollout: Tensor | None,
) -> tuple[Tensor, Tensor | None]:
    """All steps of a call, in operations that ``torch.export`` takes.

    Args:
        groups: FORWARD group of each block, numbered from zero.
        plan: int8 ``[B, K, blocks]``, legal.
        initial: the sample at step 0, ``[B, T, D]``.
        offset: what each step adds to the sample, ``[K, D, B, (1 + S) T]``.
        read: what the correction reads of the condition, ``[B, F]``; None if it reads nothing.
        rollout: residuals of earlier calls, ``[K, blocks, ...]``; None if no plan reads any.

    Returns:
        The sample ``[B, T, D]``; and ``rollout`` with what this call has computed, None where that is None.
    """
    streams, steps, blocks = plan.shape
    shape = network.stream_type.at(streams)
    of_streams = [streams if i == network.stream_type.batch_axis else 1 for i in range(len(shape))]
    first, network = begin(initial, advance), network.apart()

    def step(
        k: Tensor, sample: Tensor, history: Tensor, latest: Tensor, newest: Tensor, *more: Tensor
    ) -> tuple[Tensor, ...]:
        memory = more[0] if advance.memories else first.memory
        state = State(sample, history, memory)
        contexts, sources = network.contexts(k), plan.index_select(1, k)[:, 0]
        earlier = None if rollout is None else more[-1].index_select(0, k)[0]
        hidden = network.run(STEM, sample.permute(1, 2, 0), contexts)
        own, of_group = list(latest.unbind()), list(newest.unbind())
        kept = []
        for b in range(blocks):
            is_source = {source: (sources[:, b] == source.value).reshape(of_streams) for source in Source}
            reused = torch.where(is_source[Source.FORWARD], of_group[groups[b]], own[b])
            if earlier is not None:
                reused = torch.where(is_source[Source.ROLLOUT], earlier[b], reused)
            computing = is_source[Source.COMPUTE]
            evaluate = partial(_evaluated, network, block_name(b), hidden, contexts, computing, reused)
            residual = either(computing.any(), evaluate, reused)
            own[b] = torch.where(computing, residual, own[b])
            of_group[groups[b]] = torch.where(computing, residual, of_group[groups[b]])
            if earlier is not None:
                kept.append(torch.where(computing, residual, earlier[b]))
            hidden = hidden + residual
        prediction = network.run(TAIL, hidden, contexts).permute(2, 0, 1)
        state = advance.at(state, prediction, k, advance.jumped(k, offset.index_select(0, k)[0], read, history))
        after = [k + 1, state.sample, state.history, torch.stack(own), torch.stack(of_group)]
        after += [state.memory.contiguous()] if advance.memories else []
        after += [] if rollout is None else [more[-1].index_copy(0, k, torch.stack(kept)[None])]
        return tuple(after)

    def before_the_end(k: Tensor, *carried: Tensor) -> Tensor:
        return (k < steps)[0]

    carried = [torch.zeros(1, dtype=torch.int64, device=initial.device), first.sample, first.history]
    carried += [initial.new_zeros(count, *shape) for count in (blocks, max(groups) + 1)]
    carried += [first.memory] if advance.memories else []
    carried += [] if rollout is None else [rollout]
    last = _while(before_the_end, step, tuple(carried))
    return last[1].permute(1, 2, 0), None if rollout is None else last[-1]


def _evaluated(
    network: PlainNetwork, name: str, hidden: Tensor, contexts: Mapping[str, Tensor], computing: Tensor, reused: Tensor
) -> Tensor:
    """A block's residual, for the streams that compute it."""
    residual = torch.where(computing, network.run(name, hidden, contexts), reused)
    return residual.clone(memory_format=torch.contiguous_format)  # both branches of a cond have to have one layout


_while: Callable[..., tuple[Tensor, ...]] = while_loop


def either(flag: Tensor, then: Callable[[], Tensor], otherwise: Tensor) -> Tensor:
    """What a function gives, which is not evaluated where the flag is false; there it is ``otherwise``."""

    def same() -> Tensor:  # a branch must not give what flows into it
        return otherwise.clone(memory_format=torch.contiguous_format)

    result: Tensor = torch.cond(flag, then, same)
    return result
