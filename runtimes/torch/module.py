"""The sparse call as a module of torch: for ``torch.export``, AOTInductor, and whoever has a pipeline of torch's.

With a schedule it is the loop of the runtime (``loop``) around the literal graphs (``ir.evaluate``), whose operations
a compiler fuses as it likes: what is exported is one straight line. ``pruned_call`` makes its own plan.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, overload

import numpy as np
from torch import Tensor

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import PlanArray, Source, check_plan, require_legal
from ttscompile.errors import IllegalPlanError
from ttscompile.ir.pieces import PRUNER
from ttscompile.runtimes.instructions import Instructions, instructions_of

from .call_module import CPU, CallModule
from .loop import denoise
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
    record = artifact.manifest.plans.get(name)
    if record is None and name == PRUNER:
        known = ["dense", *artifact.manifest.plans]
        problem = f"{artifact.path}: no plan of it is made by a pruner; it has {known}"
        raise IllegalPlanError(f"{problem}. Use one of these, or calibrate with a strategy that trains the pruner.")
    correction = artifact.corrections.get(name)
    with artifact.reading():
        if record is not None and record.pruned:
            return PrunedCall(artifact, correction).eval()
        return SparseCall(artifact.with_weights_of(name), name, artifact.schedule(name), correction).eval()


class SparseCall(CallModule):
    """One call of a policy with one schedule.

    Args:
        artifact: loaded and checked, with the weights of the plan.
        name: of the plan, for messages.
        plan: int8 ``[K, blocks]``.
        correction: of the sampler's steps, which belongs to the plan; None for none.

    Raises:
        IllegalPlanError: the plan is illegal, or reads the rollout cache.
    """

    def __init__(self, artifact: Artifact, name: str, plan: PlanArray, correction: Correction | None) -> None:
        manifest = artifact.manifest
        schedule = check_plan(plan, manifest.steps, len(manifest.groups), 1)
        if (schedule == Source.ROLLOUT).any():
            problem = f"plan {name!r} reads residuals of earlier calls, and a module keeps nothing between calls"
            raise IllegalPlanError(f"{problem}. Give another plan, or use load(..., runtime='torch').")
        require_legal(schedule, manifest.groups, np.zeros(schedule.shape, np.bool_))
        super().__init__(artifact, artifact.weights, Advance(manifest.spec, correction, CPU), correction)
        self._plan: Instructions = instructions_of(schedule[0], manifest.groups)

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
        network, advance = self._network(obs, initial), self._advance.on(self._kept("advance"))
        offset, read = self._offset(network, advance, initial, steps)
        nothing = np.zeros(self._plan.computed.shape, np.bool_)
        return self._actions(denoise(network, self._plan, nothing, advance, initial, offset.unbind(), {}, read).sample)
