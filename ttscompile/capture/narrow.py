"""Predict fewer steps than the original: the first of its horizon, where they do not depend on the rest.

A policy executes the first actions of what it predicts. In a network with causal attention a step sees only those
before it, so those at the end can be left out of sample and graph; what is left stays as it was, but for rounding.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import nn

from ..core.spec import PolicySpec
from ..errors import SpecError
from ..frontends.eager import evaluation
from ..frontends.encoded import sharing_copy

TOLERANCE = 1e-4
"""Of the prediction's deviation. Rounding is a hundredth of it; a network that attends to later steps is far above."""

_STREAMS = 4


def narrow(module: nn.Module, spec: PolicySpec, prediction_horizon: int) -> tuple[PolicySpec, float]:
    """The specification of the policy that predicts only the first steps, and what that changes.

    Args:
        module: as ``compile_denoiser`` takes it; it has to accept a shorter sample.
        prediction_horizon: T, at least up to the last action that is executed.

    Returns:
        The specification; and the largest difference between predictions with and without the last steps, over the
        standard deviation of the prediction, on random inputs at the first, the middle and the last timestep.

    Raises:
        SpecError: fewer steps than are executed or more than there are; the module takes no shorter sample; or what is
            kept depends on what would be left out.
    """
    horizon, channels = spec.sample
    if not spec.chunk.stop <= prediction_horizon <= horizon:
        raise SpecError(
            f"prediction_horizon is {prediction_horizon}; expected at least {spec.chunk.stop}, as the policy executes"
            f" actions {spec.chunk.start} to {spec.chunk.stop - 1}, and at most {horizon}, which it predicts."
        )
    found = _difference(module, spec, prediction_horizon)
    if not found <= TOLERANCE:
        raise SpecError(
            f"prediction_horizon is {prediction_horizon}, but these steps depend on the {horizon - prediction_horizon}"
            f" after them: without, the prediction differs by {found:.2g} of its deviation; expected at most"
            f" {TOLERANCE:g}. Only where attention is causal can steps be left out: predict all {horizon}."
        )
    return replace(spec, sample=(prediction_horizon, channels), left_out=horizon - prediction_horizon), found


def unneeded(module: nn.Module, spec: PolicySpec) -> str | None:
    """A hint where ``narrow``, of the same arguments, could leave out steps; None where it could not."""
    (horizon, _), chunk = spec.sample, spec.chunk
    if needed(module, spec) is None:
        return None
    return (
        f"of {horizon} predicted steps {chunk.start} to {chunk.stop - 1} are executed, and none depends on a later one."
        f" A prediction horizon of {chunk.stop} or a few more gives the same actions for less (docs/howto/convert.md)."
    )


def needed(module: nn.Module, spec: PolicySpec) -> int | None:
    """How many steps a robot needs: those it executes, and half as many for a call that is late.

    None where all are needed, for the module takes no fewer or its first steps depend on the last.
    """
    (horizon, _), chunk = spec.sample, spec.chunk
    kept = min(chunk.stop + (chunk.executes + 1) // 2, horizon)
    try:
        return kept if chunk.stop < horizon and _difference(module, spec, chunk.stop) <= TOLERANCE else None
    except SpecError:
        return None


def _difference(module: nn.Module, spec: PolicySpec, steps: int) -> float:
    """Largest difference of the first steps' prediction with and without those after them, over its deviation."""
    draw, given = np.random.default_rng(0), spec.observations.items()
    observations = {key: torch.from_numpy(one.draw_normalized(draw, _STREAMS)) for key, one in given}
    sample = torch.from_numpy(draw.standard_normal((_STREAMS, *spec.sample), dtype=np.float32))
    timesteps, found = torch.from_numpy(spec.sampler.timesteps), list[float]()
    with torch.inference_mode():
        evaluate = evaluation(sharing_copy(module), spec, observations)
        for k in (0, spec.sampler.steps // 2, spec.sampler.steps - 1):
            timestep = timesteps[k].expand(_STREAMS)
            whole = evaluate(sample, timestep)[:, :steps]
            try:
                first = evaluate(sample[:, :steps], timestep)
                found.append(float((first - whole).abs().max() / whole.std()))
            except Exception as error:  # whatever the user's code raises
                raise SpecError(
                    f"the network does not take a sample of {steps} steps: {error}. Slice its masks and position tables"
                    f" to the sample's length, or predict all {spec.sample[0]} steps."
                ) from error
    return float(np.max(found))  # unlike max, not a number if one is
