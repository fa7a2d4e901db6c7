"""What a plan of an artifact wants as inputs of its single ONNX file; needs numpy alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.manifest import DENSE, DISTILLED
from ttscompile.errors import ArtifactError, IllegalPlanError
from ttscompile.ir.pieces import USE_PRUNER

from .liveness import readable_rollout


def inputs_of(path: str | Path, plan: str | None = None) -> dict[str, npt.NDArray[Any]]:
    """The inputs of a single ONNX file that are the same in every call with a plan.

    Beside these it wants the observation, the noise, and of the rollout cache what the call before gave
    (``ttscompile.lower.single_file``).

    Args:
        path: the artifact that was written beside the file, or the same zipped; it may have been calibrated since.
        plan: ``dense`` or the name of a plan of the artifact; None for its default plan.

    Raises:
        ArtifactError: the artifact is missing, damaged or of another version, or has no plan of this name.
        IllegalPlanError: the plan has weights of its own, which are not in the file.
    """
    artifact = load_artifact(path)
    manifest = artifact.manifest
    name = manifest.default_plan if plan is None else plan
    if name not in (DENSE, *manifest.plans):
        known = [DENSE, *manifest.plans]
        raise ArtifactError(f"{artifact.path}: has no plan {name!r}; it has {known}. Use one of these.")
    if name == DISTILLED and manifest.distilled is not None:
        problem = f"plan {name!r} has weights of its own, and a single file has the original's"
        raise IllegalPlanError(f"{problem}. Give another plan, or use ttscompile.load.")
    pruned = name != DENSE and manifest.plans[name].pruned
    inputs: dict[str, npt.NDArray[Any]] = {
        "plan": artifact.schedule(DENSE if pruned else name)[None],
        "rollout_keep": readable_rollout(artifact),
    }
    if pruned:
        inputs |= {USE_PRUNER: np.array(True), **artifact.pruner}
    correction = artifact.corrections.get(name)
    return inputs if correction is None else inputs | correction.inputs()
