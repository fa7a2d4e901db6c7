"""The sparse call as a module of torch: for ``torch.export``, AOTInductor, and whoever has a pipeline of torch's.

With a schedule it is the loop of the runtime (``loop``) around the literal graphs (``ir.evaluate``), whose operations
a compiler fuses as it likes: what is exported is one straight line. With the pruner it makes its own plan: the pruner,
the repair of its plan, and the loop.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Literal, overload

import numpy as np
import torch
from torch import Tensor

from ttscompile.artifact.corrections import require_fit
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import View, view_of
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import PlanArray, Source, check_plan, require_legal
from ttscompile.core.plan import Plan
from ttscompile.errors import IllegalPlanError, ObservationError
from ttscompile.ir.pieces import PRUNER
from ttscompile.runtimes.instructions import Instructions, instructions_of
from ttscompile.runtimes.plans import LoweringCache, pruner_plan, repair_plan
from ttscompile.runtimes.policy import plan_of
from ttscompile.runtimes.report import GIVEN

from .loop import denoise
from .plain_network import CPU, CallModule, PlainNetwork
from .planned_loop import SteppedAdvance, denoise_as_planned, either
from .sampler import Advance

Rollout = tuple[Tensor, Tensor]
"""The rollout cache of an episode: residuals float32 ``[K, blocks, ...]``, each of the type of the residual stream; and
bool ``[B, K, blocks]``, whether a stream has computed the residual in an earlier call."""


@overload
def to_module(path: str | Path, plan: Literal["pruner"]) -> PrunedCall: ...


@overload
def to_module(path: str | Path, plan: str | Plan | None = None) -> SparseCall | PrunedCall: ...


def to_module(path: str | Path, plan: str | Plan | None = None) -> SparseCall | PrunedCall:
    """The call of a compiled policy with one of its plans, as a module that can be exported.

    Args:
        path: the directory that ``convert`` wrote, or the same zipped.
        plan: of the artifact or of one's own, or the name of one; None for the default. In fp32, and with all tokens.

    Returns:
        On the CPU, in fp32, and in evaluation mode; ``to`` moves it. See ``SparseCall.forward``; and
        ``PrunedCall.forward`` for a plan that the pruner makes for each observation.

    Raises:
        ArtifactError: the artifact is missing, damaged or of another version, or has no plan of this name.
        IllegalPlanError: the plan is in another precision, reuses tokens, or goes on from call to call: it begins with
            the chunk before, or is a schedule that reads the rollout cache; or it is the pruner's, and there is none.
    """
    artifact = load_artifact(path)
    own = plan_of(artifact, plan)
    name = artifact.told(own) or GIVEN
    if own.otherwise is not None or own.loop in artifact.manifest.starts:
        problem = f"plan {name!r} begins with the chunk of the call before, and a module keeps nothing between calls"
        raise IllegalPlanError(f"{problem}. Give another plan, or use load(..., runtime='torch').")
    if own is not own.exact:
        has = " and ".join([*sorted(set(own.precision.values())), *["reused tokens"] * (own.tokens is not None)])
        problem = f"plan {name!r} has {has}, and a module computes all tokens of all frames in fp32"
        raise IllegalPlanError(f"{problem}. Give a plan in fp32: 'NAME@fp32', which is plan.exact.")
    view = view_of(artifact, own)
    if own.correction is not None:
        require_fit(own.correction, artifact.manifest, own.loop)
    if own.cells is None and PRUNER not in view.manifest.pieces:
        problem = f"plan {name!r} is made by a pruner, and loop {own.loop!r} has none"
        raise IllegalPlanError(f"{problem}. Give a plan with cells, by its name, say: {list(artifact.plans)}.")
    with artifact.reading():
        if own.cells is None:
            return PrunedCall(view, own.correction).eval()
        return SparseCall(view, name, own.cells, own.correction).eval()


class SparseCall(CallModule):
    """One call of a policy with one schedule.

    Args:
        view: of an artifact, for the plan.
        name: of the plan, for messages.
        plan: int8 ``[K, blocks]``.
        correction: of the sampler's steps, which belongs to the plan; None for none.

    Raises:
        IllegalPlanError: the plan is illegal, or reads the rollout cache.
    """

    def __init__(self, view: View, name: str, plan: PlanArray, correction: Correction | None) -> None:
        manifest = view.manifest
        schedule = check_plan(plan, manifest.steps, len(manifest.groups), 1)
        if (schedule == Source.ROLLOUT).any():
            problem = f"plan {name!r} reads residuals of earlier calls, and a module keeps nothing between calls"
            raise IllegalPlanError(f"{problem}. Give another plan, or use load(..., runtime='torch').")
        require_legal(schedule, manifest.groups, np.zeros(schedule.shape, np.bool_))
        super().__init__(view, view.weights, Advance(manifest.spec, correction, CPU), correction)
        self._plan: Instructions = instructions_of(schedule[0], manifest.groups)
        self._plain = None if self._far is None else instructions_of(self._plain_cells, manifest.groups)

    def forward(self, obs: Mapping[str, Tensor], initial: Tensor, steps: Tensor | None = None) -> Tensor:
        """One call.

        Args:
            obs: observations by key, ``[B, ...]`` each, not normalised: as ``predict_action`` takes them.
            initial: the noise that the sample starts from, float32 ``[B, T, D]``.
            steps: noise of the steps, float32 ``[K, B, T, D]``; needed if the sampler draws noise, else not looked at.

        Returns:
            The actions of all predicted steps, float32 ``[B, T, Da]``, in their own units (``action_pred``).

        Raises:
            ObservationError: an observation or noise of another shape or dtype, or missing.
        """
        network = self._network(obs, initial)
        advance, offset, read = self._moves(network, initial, steps)
        sample, _ = denoise(network, self._plan, (), advance, initial, offset.unbind(), {}, read)
        if self._plain is None:
            return self._actions(sample, obs)
        plain, far = self._plain, self._is_far(network)
        uncorrected, others, _ = self._moves(network, initial, steps, corrected=False)

        def some_plain() -> Tensor:
            made, _ = denoise(network, plain, (), uncorrected, initial, others.unbind(), {}, None)
            return torch.where(far[:, None, None], made, sample).clone(memory_format=torch.contiguous_format)

        if not torch.compiler.is_compiling():
            return self._actions(some_plain() if far.any() else sample, obs)
        network.know_steps(len(plain.counts))
        return self._actions(either(far.any(), some_plain, sample), obs)


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
        lattice, device = (self.spec.sampler.steps, len(self._groups)), self.kept("offset")["noise"].device
        residuals = torch.zeros(*lattice, *self._type.at(streams), device=device)
        return residuals, torch.zeros(streams, *lattice, dtype=torch.bool, device=device)

    def forward(
        self, obs: Mapping[str, Tensor], initial: Tensor, steps: Tensor | None = None, rollout: Rollout | None = None
    ) -> tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Rollout]:
        """One call. ``obs``, ``initial`` and ``steps`` are those of ``SparseCall.forward``.

        Args:
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
        residuals, written = empty if rollout is None else rollout
        for name, found, expected in zip(("residuals", "written"), (residuals, written), empty, strict=True):
            if found.shape != expected.shape or found.dtype != expected.dtype:
                kinds = [f"{value.dtype} {list(value.shape)}" for value in (expected, found)]
                raise ObservationError(f"rollout: expected {name} {kinds[0]}; found {kinds[1]}. Use empty_rollout.")
        if not torch.compiler.is_compiling():
            return self._by_plan(network, obs, initial, steps, residuals, written, rollout is not None)
        logits = network.logits()
        plan = _repaired(logits.argmax(-1).to(torch.int8), written)
        advance, offset, read = self._moves(network, initial, steps)
        if self._far is not None:  # the loop is in the program once: one stream that is far outside decides for all
            far = self._is_far(network).any()
            uncorrected, other_offset, _ = self._moves(network, initial, steps, corrected=False)
            plain, own = uncorrected.tensors(), advance.tensors()
            # Without a correction no jump is numbered.
            own |= {name: torch.where(far, plain[name], own[name]) for name in ("updates", "remember", "number")}
            advance, offset = advance.on(own), torch.where(far, other_offset, offset)
            plan = torch.where(far, torch.tensor(self._plain_cells), plan)
        assert isinstance(advance, SteppedAdvance)
        cache = residuals if rollout is not None else None
        sample, cache = denoise_as_planned(network, self._groups, plan, advance, initial, offset, read, cache)
        broken = torch.where(logits.isnan().flatten(1).any(1), torch.nan, 0.0)
        actions = self._actions(sample, obs) + broken[:, None, None]
        return (actions, plan) if cache is None else (actions, plan, (cache, written | (plan == Source.COMPUTE.value)))

    def _by_plan(
        self,
        network: PlainNetwork,
        obs: Mapping[str, Tensor],
        initial: Tensor,
        steps: Tensor | None,
        residuals: Tensor,
        written: Tensor,
        keeps: bool,
    ) -> tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Rollout]:
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
            own, steps_of = initial.index_select(0, members), offset.index_select(2, members).unbind()
            seen = None if read is None else read.index_select(0, members)
            part, computed = denoise(network.of(members), line, keep, advance, own, steps_of, reads, seen)
            sample = sample.index_copy(0, members, part)
            for cell, residual in computed.items():
                after.flatten(0, 1)[cell].index_copy_(axis, members, residual)
        plan = torch.from_numpy(plans).to(initial.device)
        actions = self._actions(sample, obs)
        return (actions, plan, (after, written | (plan == Source.COMPUTE.value))) if keeps else (actions, plan)


def _repaired(plan: Tensor, written: Tensor) -> Tensor:
    """``lattice.without_illegal_reads`` in operations that are exported."""
    missing = (plan == Source.ROLLOUT.value) & ~written
    plan = torch.where(missing, Source.TIMESTEP.value, plan).to(torch.int8)
    return torch.cat([torch.zeros_like(plan[:, :1]), plan[:, 1:]], 1)
