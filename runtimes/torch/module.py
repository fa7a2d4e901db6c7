"""The sparse call as a module of torch: for ``torch.export``, AOTInductor, and whoever has a pipeline of torch's.

With a schedule it is the loop of the runtime (``loop``) around the literal graphs (``ir.evaluate``), whose operations
a compiler fuses as it likes: what is exported is one straight line. ``pruned_call`` makes its own plan.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, overload

import numpy as np
import torch
from torch import Tensor

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import View, view_of
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import PlanArray, Source, check_plan, require_legal
from ttscompile.errors import IllegalPlanError
from ttscompile.ir.pieces import PRUNER
from ttscompile.runtimes.instructions import Instructions, instructions_of

from .loop import denoise
from .plain_network import CPU, CallModule
from .planned_loop import either
from .pruned_call import PrunedCall
from .sampler import Advance


@overload
def to_module(path: str | Path, plan: Literal["pruner"]) -> PrunedCall: ...


@overload
def to_module(path: str | Path, plan: str | None = None) -> SparseCall | PrunedCall: ...


def to_module(path: str | Path, plan: str | None = None) -> SparseCall | PrunedCall:
    """The call of a compiled policy with one of its plans, as a module that can be exported.

    Args:
        path: the directory that ``convert`` wrote, or the same zipped.
        plan: ``dense`` or the name of a plan of the artifact; None for its default plan.

    Returns:
        On the CPU, in fp32, and in evaluation mode; ``to`` moves it. See ``SparseCall.forward``; and
        ``PrunedCall.forward`` for a plan that the pruner makes for each observation.

    Raises:
        ArtifactError: the artifact is missing, damaged or of another version, or has no plan of this name.
        IllegalPlanError: the plan is a schedule that reads the rollout cache, which lives from call to call; or it is
            the pruner's, and the artifact has no such plan.
    """
    artifact = load_artifact(path)
    name = artifact.manifest.default_plan if plan is None else plan
    if plan == PRUNER and PRUNER not in artifact.plans:
        known = [one for one, each in artifact.plans.items() if each.otherwise is None]
        problem = f"{artifact.path}: no plan of it is made by a pruner; it has {known}"
        raise IllegalPlanError(f"{problem}. Use one of these, or calibrate with a proposer that trains the pruner.")
    own = artifact.plan(name).exact
    if own.otherwise is not None:
        problem = f"plan {name!r} begins with the chunk of the call before, and a module keeps nothing between calls"
        raise IllegalPlanError(f"{problem}. Give another plan, or use load(..., runtime='torch').")
    view = view_of(artifact, own)
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
            return self._actions(sample)
        plain, far = self._plain, self._is_far(network)
        uncorrected, others, _ = self._moves(network, initial, steps, corrected=False)

        def some_plain() -> Tensor:
            made, _ = denoise(network, plain, (), uncorrected, initial, others.unbind(), {}, None)
            return torch.where(far[:, None, None], made, sample).contiguous()

        if not torch.compiler.is_compiling():
            return self._actions(some_plain() if far.any() else sample)
        network.know_steps(len(plain.counts))
        return self._actions(either(far.any(), some_plain, sample))
