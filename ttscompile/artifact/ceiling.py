"""How far a plan may go: from the original, and with a number of denoising steps."""

from .manifest import Manifest

BOUND = 0.1
"""Distance from the original up to which a plan is chosen as the default. Plans further away cost successes: one at
0.16 lost 6 points in 800 paired episodes ("What a distance means" in ``docs/evidence/results.md``)."""

FARTHEST = 0.25
"""Distance up to which a plan is offered at all. Up to it plans lost as many as 16.5 points of success; same page."""

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
        f" no plan has less than {1 / manifest.flops.ceiling(steps):.1%} of the FLOPs of a dense call."
    )


def uncalibrated(manifest: Manifest) -> str:
    """What it means that an artifact is not calibrated."""
    dense = "Not calibrated: every call is dense. Run 'ttscompile calibrate' to give it a plan."
    return NOTHING if manifest.steps == 1 else dense
