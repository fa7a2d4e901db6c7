"""What a plan of an artifact wants as inputs of its single ONNX file; needs numpy alone."""

from pathlib import Path

import numpy as np

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.coercion import Array
from ttscompile.core.envelope import plain_cells
from ttscompile.core.lattice import dense_plan
from ttscompile.core.plan import DENSE, FULL
from ttscompile.core.spec import FP32, ORIGINAL
from ttscompile.errors import IllegalPlanError
from ttscompile.ir.pieces import USE_PRUNER

from .liveness import readable_rollout


def inputs_of(path: str | Path, plan: str | None = None, streams: int = 1) -> dict[str, Array]:
    """The inputs of a single ONNX file for the first call of an episode with a plan, without observation and noise.

    Later calls of the episode are given ``rollout_rows`` and ``rollout_index`` as the call before left them.

    Args:
        path: the artifact that was written beside the file, or the same zipped; it may have been calibrated since.
        plan: the name of a plan of the artifact; None for its default plan.
        streams: B, of the observation and the noise.

    Raises:
        ArtifactError: the artifact is missing, damaged or of another version.
        IllegalPlanError: there is no plan of this name; or it has weights of its own, reuses tokens or begins with the
            chunk of the call before, which a file cannot; or it is in another loop or precision than the file.
    """
    artifact = load_artifact(path)
    name = artifact.manifest.default_plan if plan is None else plan
    own = artifact.plan(name)
    for field, there in (("weights of its own", own.weights != ORIGINAL), ("a chunk to begin with", own.otherwise)):
        if there:
            problem = f"plan {name!r} has {field}, and a single file has the original's weights and begins with noise"
            raise IllegalPlanError(f"{problem}. Give another plan, or use ttscompile.load.")
    loop = artifact.plans.get(FULL, artifact.plans[DENSE]).loop  # which ``convert`` was asked for
    if own.loop != loop:
        problem = f"plan {name!r} is {own.in_words()}, and a single file of this artifact is of loop {loop!r}"
        raise IllegalPlanError(f"{problem}. Give a plan of that loop, or use ttscompile.load.")
    record = artifact.manifest.precision
    bits, computed = artifact.manifest.precision_name, FP32 if record is None else record.told
    # The file computes in the precision of ``convert``, and all tokens, whatever a plan says.
    if own.tokens is not None or own.precision != artifact.manifest.held:
        problem = f"plan {name!r} is {own.in_words()}, and a single file of this artifact has all tokens, {computed}"
        remedy = f"Give {name.partition('@')[0] + '@' + bits!r}, or use ttscompile.load."
        raise IllegalPlanError(f"{problem}. {remedy}")
    view = view_of(artifact, own)
    blocks, steps = view.manifest.blocks, view.manifest.steps
    cells = dense_plan(steps, len(blocks)) if own.cells is None else own.cells
    inputs: dict[str, Array] = {"plan": cells[None], "rollout_keep": readable_rollout(view)}
    inputs["rollout_rows"] = np.zeros((0, *blocks[0].type.at(1)), np.float32)
    inputs["rollout_index"] = np.full((streams, steps, len(blocks)), -1, np.int64)
    if own.pruned:
        inputs |= {USE_PRUNER: np.array(True), **view.pruner}
    if own.correction is None:
        return inputs
    if artifact.envelope is not None:
        inputs |= artifact.envelope.inputs(plain_cells(own.correction, len(blocks)))
    return inputs | own.correction.inputs()
