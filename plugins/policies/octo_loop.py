"""Octo's denoising loop: DDPM on the betas of a squared cosine, whose every result is clipped.

Source: ``DiffusionActionHead.predict_action`` of octo-models/octo at 241fb35.
"""

import numpy as np

from ttscompile.core.spec import FloatArray, SamplerTable
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.scheduler import configured_sampler

from .networks.octo_network import Head


def schedule(steps: int) -> tuple[FloatArray, FloatArray]:
    """Betas of a squared cosine and shares of the actions in the variance, in float32 as the original computes them."""
    one = np.float32(1)
    time = np.linspace(0, steps, steps + 1, dtype=np.float32) / np.float32(steps)
    whole = np.cos((time + np.float32(0.008)) / np.float32(1.008) * np.float32(np.pi) * np.float32(0.5)) ** 2
    whole = whole / whole[0]
    betas = np.clip(one - whole[1:] / whole[:-1], 0, np.float32(0.999)).astype(np.float32)
    return betas, np.cumprod(one - betas, dtype=np.float32)


def loop_table(head: Head, betas: FloatArray, signal: FloatArray, options: LoadOptions, where: str) -> SamplerTable:
    """The loop that is asked for; without one the original's."""
    own = options.sampler in (None, "ddpm") and options.spacing is None and options.steps in (None, head.steps)
    if own:
        return own_table(betas, signal, head.bound)
    settings = {
        "_target_": f"diffusers.{'DDIM' if options.sampler == 'ddim' else 'DDPM'}Scheduler",
        "trained_betas": betas.tolist(),
        "num_train_timesteps": head.steps,
        "clip_sample": options.sampler != "dpmsolver++",  # which bounds at 1 or not at all
        "clip_sample_range": head.bound,
    }
    return configured_sampler(settings, head.steps, options, where=f"{where}the schedule")


def own_table(betas: FloatArray, signal: FloatArray, bound: float) -> SamplerTable:
    """The original's loop: a step of DDPM whose result is clipped, noise and all, and the next step reads that.

    The one bound of a table is for its x0. But for the first and the last step x0 stands for the clipped sample; in the
    last one, after which no noise is added, for what is predicted. ``OctoDenoiser`` predicts the noise of the sample
    before it was clipped, ``w`` of which is what the step takes for the whole::

        next = (clipped - spread * noise of clipped) / root = ((1 - w) clipped + w sample - spread * predicted) / root
    """
    beta, kept = (np.asarray(each, np.float64)[::-1] for each in (betas, signal))
    root, deviation = np.sqrt(1 - beta), np.sqrt(1 - kept)
    share = beta / (1 - kept)
    steps = len(beta)
    first, last = np.arange(steps) == 0, np.arange(steps) == steps - 1
    columns = {
        "sample_to_x0": np.where(last, 1 / np.sqrt(kept), 1.0),
        "out_to_x0": np.where(last, -deviation / np.sqrt(kept), 0.0),
        "x0_to_next": np.where(last, 1.0, np.where(first, 0.0, (1 - share) / root)),
        "sample_to_next": np.where(last, 0.0, np.where(first, 1.0, share) / root),
        "out_to_next": np.where(last, 0.0, -beta / deviation / root),
        "noise_to_next": np.where(last, 0.0, np.sqrt(beta)),
    }
    narrow = {name: column.astype(np.float32) for name, column in columns.items()}
    return SamplerTable("ddpm", np.arange(steps)[::-1].copy(), clip=bound, **narrow)
