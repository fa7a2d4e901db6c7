"""How far a plan may go: from the original, and with a number of denoising steps; and when fewer of them are better."""

from __future__ import annotations

from .manifest import Manifest

BOUND = 0.1
"""Distance from the original up to which a plan is chosen as the default. Plans further away cost successes: one at
0.16 lost 6 points in 800 paired episodes ("What a distance means" in ``docs/evidence/results.md``)."""

FARTHEST = 0.25
"""Distance up to which a plan is offered at all. Up to it plans lost as many as 10.5 points of success; same page."""

TYPICAL_SPARSITY = 0.95
"""What the method's authors aim at, with 100 steps."""

FEWEST_STEPS = 5
"""Whole steps that are computed, if nobody asks for fewer. Push-T with the 16 steps of DPM-Solver++: five leave the
score and nearly the success of all of them, four the score, three neither."""

NOTHING = (
    "One evaluation gives the actions: there is nothing to reuse between steps. What makes such a policy faster is"
    " compilation, eight bits, and that frames are computed once."
)
"""Said of a policy of one step."""

SOLVER_STEPS = 16
"""Of DPM-Solver++, as suggested in place of many steps."""


def usual_sparsity(steps: int) -> float:
    """Share of the cells of K steps to reuse where no budget is given."""
    return min(TYPICAL_SPARSITY, 1 - min(FEWEST_STEPS, steps // 2) / steps)


def few_steps(manifest: Manifest) -> str | None:
    """A warning where the steps are too few for ``TYPICAL_SPARSITY``, with the ceiling; None where they are not."""
    steps = manifest.steps
    if steps == 1:
        return NOTHING
    if (most := 1 - 1 / steps) >= TYPICAL_SPARSITY:
        return None
    return (
        f"K = {steps} denoising steps: step 0 is always computed, so at most {most:.1%} of the cells can be reused, and"
        f" no plan has less than 1/{manifest.flops.ceiling(steps):.3g} of the FLOPs of a dense call."
    )


def uncalibrated(manifest: Manifest) -> str:
    """What it means that an artifact is not calibrated."""
    dense = "Not calibrated: every call is dense. Run 'ttscompile calibrate' to give it a plan."
    return NOTHING if manifest.steps == 1 else dense


def many_steps(manifest: Manifest) -> str | None:
    """A hint where a solver of higher order takes fewer steps for as good actions; None where there is none.

    On Push-T five of the 16 steps of DPM-Solver++ are a little faster than five of the 100 of DDPM, and score no less
    (`docs/decisions.md`).
    """
    sampler = manifest.spec.sampler
    if sampler.name not in ("ddpm", "ddim") or sampler.steps < 2 * SOLVER_STEPS:
        return None
    return (
        f"{sampler.name} with K = {sampler.steps} steps. '--sampler dpmsolver++ --steps {SOLVER_STEPS}' needs no"
        " training, and reuse comes on top: faster at an equal score where we measured it (docs/howto/sampler.md)."
        " Convert both, and compare them on your task."
    )
