"""What reuse can save at most, which the number of denoising steps decides."""

from __future__ import annotations

from .manifest import Manifest

TYPICAL_SPARSITY = 0.95
"""What calibration aims at where nothing else is asked for; with fewer than 20 steps it cannot be reached."""


def few_steps(manifest: Manifest) -> str | None:
    """A warning where the steps are too few for the usual sparsity, with the ceiling; None where they are not.

    Args:
        manifest: of the artifact.
    """
    steps = manifest.steps
    most = 1 - 1 / steps
    if most >= TYPICAL_SPARSITY:
        return None
    return (
        f"K = {steps} denoising steps leave reuse little room: step 0 is always computed, so at most {most:.1%} of the"
        f" cells can be reused, and no plan has less than 1/{manifest.flops.ceiling(steps):.3g} of the FLOPs of a dense"
        " call. Neighbouring steps also differ more than those of a longer loop: expect a good deal less."
    )
