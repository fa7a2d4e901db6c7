"""What reuse can save at most, which the number of denoising steps decides, and what is asked for if nobody says."""

from __future__ import annotations

from .manifest import Manifest

TYPICAL_SPARSITY = 0.95
"""What the method's authors aim at, with 100 steps."""

FEWEST_STEPS = 4
"""Whole steps that are computed, if nobody asks for fewer. Push-T with the 16 steps of DPM-Solver++: four of them leave
actions 0.6 px from all of them, three 2.0."""


def usual_sparsity(steps: int) -> float:
    """Share of the cells to reuse where no budget is given.

    Args:
        steps: K.
    """
    return min(TYPICAL_SPARSITY, 1 - min(FEWEST_STEPS, steps // 2) / steps)


def few_steps(manifest: Manifest) -> str | None:
    """A warning where the steps are too few for ``TYPICAL_SPARSITY``, with the ceiling; None where they are not.

    Args:
        manifest: of the artifact.
    """
    steps = manifest.steps
    most = 1 - 1 / steps
    if most >= TYPICAL_SPARSITY:
        return None
    return (
        f"K = {steps} denoising steps: step 0 is always computed, so at most {most:.1%} of the cells can be reused, and"
        f" no plan has less than 1/{manifest.flops.ceiling(steps):.3g} of the FLOPs of a dense call."
    )
