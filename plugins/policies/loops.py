"""The denoising loop that these heads were trained for: DDIM on the betas of a squared cosine, predicting the noise."""

from pathlib import Path
from typing import Any

from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.loops import Loops
from ttscompile.frontends.scheduler import configured_loops

SCHEDULER = {"_target_": "diffusers.DDIMScheduler", "beta_schedule": "squaredcos_cap_v2", "clip_sample": True}
"""What no head says otherwise is diffusers' default: predictions of the noise, and a final alpha of one."""


def ddim_loops(where: Path, steps: int, options: LoadOptions, **settings: Any) -> Loops:
    """The head's own loop, and what is asked for beside it.

    Args:
        where: the settings stand, for messages.
        settings: of the scheduler, in place of those above.
    """
    return configured_loops(SCHEDULER | settings, steps, options, where=str(where))
