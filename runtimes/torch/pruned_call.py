"""The sparse call as a module that makes its own plan: the pruner, the repair of its plan, and the loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch._higher_order_ops.while_loop import while_loop

from ttscompile.artifact.view import View
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import Source
from ttscompile.core.spec import PolicySpec
from ttscompile.errors import ObservationError
from ttscompile.ir.pieces import STEM, TAIL, block_name
from ttscompile.runtimes.instructions import Instructions, instructions_of
from ttscompile.runtimes.plans import LoweringCache, pruner_plan, repair_plan

from .loop import denoise
from .plain_network import CPU, CallModule, PlainNetwork
from .sampler import Advance, State, begin

Rollout = tuple[Tensor, Tensor]
"""The rollout cache of an episode: residuals float32 ``[K, blocks, ...]``, each of the type of the residual stream; and
bool ``[B, K, blocks]``, whether a stream has computed the residual in an earlier call."""


class PrunedCall(CallModule):
    """One call of a policy with the plan that its pruner makes of the observation.

    What is skipped: a reused cell adds a tensor, and its block is not evaluated. As the module stands, streams of one
    plan are a batch of their own, so each stream computes what its plan says, and no more. Exported, or compiled, it is
    one loop over the steps (``torch.while_loop``) in which each block is a ``torch.cond``: it is not evaluated at a
    step if no stream of the batch computes it there, and otherwise for all of them. For one stream both are the same.
    Stem, tail and sampler are computed at every step.
    """

    def __init__(self, view: View, correction: Correction | None) -> None:
        manifest = view.manifest
        advance = SteppedAdvance(manifest.spec, correction, CPU)
        super().__init__(view, {**view.weights, **view.pruner}, advance, correction)
        self._type = manifest.blocks[0].type
        numbers = {group: number for number, group in enumerate(dict.fromkeys(manifest.groups))}
        self._groups = tuple(numbers[group] for group in manifest.groups)
        self._lowering = LoweringCache(partial(instructions_of, groups=self._groups))

    def empty_rollout(self, streams: int) -> Rollout:
        """The rollout cache at the start of an episode of so many streams, where the module is."""
        lattice, device = (self.spec.sampler.steps, len(self._groups)), self._kept("offset")["noise"].device
        residuals = torch.zeros(*lattice, *self._type.at(streams), device=device)
        return residuals, torch.zeros(streams, *lattice, dtype=torch.bool, device=device)

    def forward(
        self, obs: Mapping[str, Tensor], initial: Tensor, steps: Tensor | None = None, rollout: Rollout | None = None
    ) -> tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Rollout]:
        """One call.

        Args:
            obs: observations by key, ``[B, ...]`` each, not normalised: as ``predict_action`` takes them.
            initial: the noise that the sample starts from, float32 ``[B, T, D]``.
            steps: noise of the steps, float32 ``[K, B, T, D]``; needed if the sampler draws noise, else not looked at.
            rollout: what the call before gave, or ``empty_rollout`` in the first call of an episode. Without it no
                residual of an earlier call is there, and cells that want one have TIMESTEP.

        Returns:
            The actions of all predicted steps, float32 ``[B, T, Da]``, in their own units (``action_pred``); the plan
            that was executed, int8 ``[B, K, blocks]`` of ``Source``; and, if ``rollout`` was given, that of the next
            call.

        Raises:
            ObservationError: an observation, noise or a rollout cache of another shape or dtype, or missing.
            IllegalPlanError: the pruner's weights are broken, so that its logits are NaN. Exported, the actions of such
                a stream are NaN.
        """
        network = self._network(obs, initial)
        empty = self.empty_rollout(len(initial))
        if rollout is not None:
            self._check(rollout, empty)
        residuals, written = empty if rollout is None else rollout
        if not torch.compiler.is_compiling():
            return self._by_plan(network, initial, steps, residuals, written, rollout is not None)
        logits = network.logits()
        plan = _repaired(logits.argmax(-1).to(torch.int8), written)
        advance, offset, read = self._moves(network, initial, steps)
        if self._far is not None:  # the loop is in the program once: one stream that is far outside decides for all
            far = self._is_far(network).any()
            uncorrected, other_offset, _ = self._moves(network, initial, steps, corrected=False)
            advance, offset = advance.on(_chosen(far, uncorrected, advance)), torch.where(far, other_offset, offset)
            plan = torch.where(far, torch.tensor(self._plain_cells), plan)
        assert isinstance(advance, SteppedAdvance)
        cache = residuals if rollout is not None else None
        sample, cache = denoise_as_planned(network, self._groups, plan, advance, initial, offset, read, cache)
        broken = torch.where(logits.isnan().flatten(1).any(1), torch.nan, 0.0)
        actions = self._actions(sample) + broken[:, None, None]
        return (actions, plan) if cache is None else (actions, plan, (cache, written | (plan == Source.COMPUTE.value)))

    def _by_plan(
        self,
        network: PlainNetwork,
        initial: Tensor,
        steps: Tensor | None,
        residuals: Tensor,
        written: Tensor,
        keeps: bool,
    ) -> tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Rollout]:
        """The call, with a batch for each different plan."""
        logits = network.logits().detach().cpu().numpy()
        plans, _ = repair_plan(pruner_plan(logits), written.cpu().numpy())
        far = np.zeros(len(plans), np.bool_) if self._far is None else self._is_far(network).cpu().numpy()
        if far.any():
            plans = np.where(far[:, None, None], self._plain_cells, plans)
        moves = {bool(one): self._moves(network, initial, steps, corrected=not one) for one in np.unique(far)}
        alike: dict[tuple[bytes, bool], list[int]] = {}
        for stream, one in enumerate(plans):
            alike.setdefault((one.tobytes(), bool(far[stream])), []).append(stream)
        keep = range(plans[0].size if keeps else 0)
        sample, after, axis = initial.clone(), residuals.clone() if keeps else residuals, self._type.batch_axis or 0
        for (_, away), some in alike.items():
            advance, offset, read = moves[away]
            members = torch.tensor(some, device=initial.device)
            line: Instructions = self._lowering.lower(plans[some[0]])
            reads = {
                cell: residuals.flatten(0, 1)[cell].index_select(axis, members)
                for cell in np.flatnonzero(line.rollout).tolist()
            }
            part, computed = denoise(
                network.of(members),
                line,
                keep,
                advance,
                initial.index_select(0, members),
                offset.index_select(2, members).unbind(),
                reads,
                None if read is None else read.index_select(0, members),
            )
            sample = sample.index_copy(0, members, part)
            for cell, residual in computed.items():
                after.flatten(0, 1)[cell].index_copy_(axis, members, residual)
        plan = torch.from_numpy(plans).to(initial.device)
        actions = self._actions(sample)
        return (actions, plan, (after, written | (plan == Source.COMPUTE.value))) if keeps else (actions, plan)

    def _check(self, rollout: Rollout, like: Rollout) -> None:
        for name, found, expected in zip(("residuals", "written"), rollout, like, strict=True):
            if found.shape != expected.shape or found.dtype != expected.dtype:
                kinds = [f"{value.dtype} {list(value.shape)}" for value in (expected, found)]
                raise ObservationError(f"rollout: expected {name} {kinds[0]}; found {kinds[1]}. Use empty_rollout.")


def _chosen(far: Tensor, uncorrected: Advance, corrected: Advance) -> dict[str, Tensor]:
    """The tensors of one of two, which a tensor decides; without a correction no jump is numbered."""
    plain, tensors = uncorrected.tensors(), corrected.tensors()
    return tensors | {name: torch.where(far, plain[name], tensors[name]) for name in ("updates", "remember", "number")}


def _repaired(plan: Tensor, written: Tensor) -> Tensor:
    """``lattice.without_illegal_reads`` in operations that are exported."""
    missing = (plan == Source.ROLLOUT.value) & ~written
    plan = torch.where(missing, Source.TIMESTEP.value, plan).to(torch.int8)
    return torch.cat([torch.zeros_like(plan[:, :1]), plan[:, 1:]], 1)


class SteppedAdvance(Advance):
    """The sampler, also at a step that only the program knows."""

    def __init__(self, spec: PolicySpec, correction: Correction | None, device: torch.device) -> None:
        super().__init__(spec, correction, device)
        number = np.full(self.steps, -1, np.int64)
        for each, landing in self.jumps.values():
            number[landing] = each
        self._columns = torch.tensor(self._to_clean, dtype=torch.float32, device=device)
        self._remember = torch.tensor(self._anchors, device=device)
        self._number = torch.tensor(number, device=device)

    def tensors(self) -> dict[str, Tensor]:
        """See ``Advance.tensors``."""
        own = {"columns": self._columns, "remember": self._remember, "number": self._number}
        return super().tensors() | own

    def on(self, tensors: Mapping[str, Tensor]) -> SteppedAdvance:
        """See ``Advance.on``."""
        other = super().on(tensors)
        assert isinstance(other, SteppedAdvance)
        other._columns, other._remember, other._number = (tensors[n] for n in ("columns", "remember", "number"))
        return other

    def at(self, state: State, prediction: Tensor, k: Tensor, offset: Tensor) -> State:
        """What is carried to the step after k, which is int64 ``[1]``."""
        clean = None
        if self._clip is not None:
            of_sample, of_prediction = self._columns.index_select(0, k)[0].unbind()
            clean = (state.sample * of_sample + prediction * of_prediction).clamp(-self._clip, self._clip)
        matrix = self._plain.index_select(0, k)[0].expand(len(state.sample), -1, -1)
        moved = self._moved(state, prediction, clean, matrix, offset)
        anchor = self._remember.index_select(0, k)
        return moved._replace(history=torch.where(anchor, self._longer(state, prediction), state.history))

    def jumped(self, k: Tensor, offset: Tensor, read: Tensor | None, history: Tensor) -> Tensor:
        """The offset of step k, with the jump that ends there if one does."""
        if not self.layers:
            return offset
        number = self._number.index_select(0, k)

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
    """All steps of a call with plans that only the program knows, in operations that ``torch.export`` takes.

        while k < K:                                                           while_loop
            stream = stem(sample)
            for each block:
                residual = block(stream), if any stream computes it            cond
                           what the plan says otherwise, without evaluating it
                stream += residual
            sample = the sampler's step of tail(stream)

    It is in the program once, with every block once, whatever K is. A block is evaluated for all streams if one of them
    computes it; the others then take what they reuse.

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
        stream = network.run(STEM, sample.permute(1, 2, 0), contexts)
        own, of_group = list(latest.unbind()), list(newest.unbind())
        kept = []
        for b in range(blocks):
            is_source = {source: (sources[:, b] == source.value).reshape(of_streams) for source in Source}
            reused = torch.where(is_source[Source.FORWARD], of_group[groups[b]], own[b])
            if earlier is not None:
                reused = torch.where(is_source[Source.ROLLOUT], earlier[b], reused)
            computing = is_source[Source.COMPUTE]
            evaluate = partial(_evaluated, network, block_name(b), stream, contexts, computing, reused)
            residual = either(computing.any(), evaluate, reused)
            own[b] = torch.where(computing, residual, own[b])
            of_group[groups[b]] = torch.where(computing, residual, of_group[groups[b]])
            if earlier is not None:
                kept.append(torch.where(computing, residual, earlier[b]))
            stream = stream + residual
        prediction = network.run(TAIL, stream, contexts).permute(2, 0, 1)
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
    network: PlainNetwork, name: str, stream: Tensor, contexts: Mapping[str, Tensor], computing: Tensor, reused: Tensor
) -> Tensor:
    """A block's residual, for the streams that compute it."""
    residual = torch.where(computing, network.run(name, stream, contexts), reused)
    return residual.clone(memory_format=torch.contiguous_format)  # both branches of a cond have to have one layout


_while: Callable[..., tuple[Tensor, ...]] = while_loop


def either(flag: Tensor, then: Callable[[], Tensor], otherwise: Tensor) -> Tensor:
    """What a function gives, which is not evaluated where the flag is false; there it is ``otherwise``."""

    def same() -> Tensor:  # a branch must not give what flows into it
        return otherwise.clone(memory_format=torch.contiguous_format)

    result: Tensor = torch.cond(flag, then, same)
    return result
