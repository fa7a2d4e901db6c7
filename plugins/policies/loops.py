"""The denoising loop that these heads were trained for: DDIM on the betas of a squared cosine, predicting the noise."""

from pathlib import Path
from typing import Any

from diffusers.schedulers.scheduling_ddim import DDIMScheduler

from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.loops import Loops, loops_of
from ttscompile.frontends.scheduler import configured_loops, configured_sampler

from .last_step import changed, clipped

SCHEDULER = {"_target_": "diffusers.DDIMScheduler", "beta_schedule": "squaredcos_cap_v2", "clip_sample": True}
"""What no head says otherwise is diffusers' default: predictions of the noise, and a final alpha of one."""

TIMESTEPS = 100
RESPACED: dict[str, Any] = {**SCHEDULER, "num_train_timesteps": TIMESTEPS, "clip_sample": False}
"""Of the training of CogACT and HybridVLA."""


def ddim_loops(where: Path, steps: int, options: LoadOptions, **settings: Any) -> Loops:
    """The head's own loop, and what is asked for beside it.

    Args:
        where: the settings stand, for messages.
        settings: of the scheduler, in place of those above.
    """
    return configured_loops(SCHEDULER | settings, steps, options, where=str(where))


def respaced_loops(where: Path, steps: int, options: LoadOptions) -> Loops:
    """The same of CogACT and HybridVLA, whose ``predict_action`` clips what the loop gives, and nothing before.

    Their DDIM has another stride than diffusers' where the number of steps does not divide 100: the smallest one that
    gives so many timesteps, 13 for 8 steps, and not 12 (``space_timesteps`` of ``respace.py``). One step is at 50.
    Where no stride gives the number, as for 16, the originals fail, and diffusers' is taken.
    """

    def settings(asked: LoadOptions) -> dict[str, Any]:
        wanted = steps if asked.steps is None else asked.steps
        if asked.sampler not in (None, "ddim") or asked.spacing is not None:
            return RESPACED
        if wanted == 1:
            return RESPACED | {"steps_offset": TIMESTEPS // 2}
        stride = next((each for each in range(1, TIMESTEPS) if len(range(0, TIMESTEPS, each)) == wanted), None)
        if stride is None:
            return RESPACED
        # diffusers takes the stride from the number of timesteps; each that it visits then has its beta among these.
        betas = DDIMScheduler(TIMESTEPS, beta_schedule=SCHEDULER["beta_schedule"]).betas.tolist()
        return RESPACED | {"num_train_timesteps": wanted * stride, "trained_betas": betas}

    found = loops_of(
        lambda asked: configured_sampler(settings(asked), steps, asked, where=f"{where}: the sampler"),
        options,
        "DDIMScheduler",
    )
    return changed(found, lambda table: clipped(table, 1.0))
