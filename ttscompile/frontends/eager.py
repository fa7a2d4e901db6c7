"""The policy's denoising loop in plain PyTorch: what a compiled policy is measured against."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import nn

from ..config import Noise, PolicySpec
from ..errors import ObservationError

EagerPolicy = Callable[[Mapping[str, torch.Tensor], Noise], torch.Tensor]


def eager_policy(module: nn.Module, spec: PolicySpec) -> EagerPolicy:
    """The loop as the original runs it: the whole network, condition encoder included, once a step.

    Args:
        module: as ``load_checkpoint_policy`` gives it.
        spec: of the same policy.

    Returns:
        A function of the normalised observations ``{key: [B, ...]}`` and the noise of one call, that gives the
        denoised sample ``[B, T, D]``. Runs on the CPU. Raises ObservationError if a stochastic sampler is given no
        ``noise.steps``.
    """
    table = spec.sampler
    rows = [tuple(float(getattr(table, column)[k]) for column in table.COLUMNS) for k in range(table.steps)]
    timesteps = torch.from_numpy(table.timesteps)

    def run(observations: Mapping[str, torch.Tensor], noise: Noise) -> torch.Tensor:
        if table.stochastic and noise.steps is None:
            raise ObservationError(
                f"noise.steps is None, but sampler {table.name} draws noise; expected [K, B, T, D], K = {table.steps}."
            )
        with torch.inference_mode():
            x = torch.from_numpy(noise.initial)
            draws = None if noise.steps is None else torch.from_numpy(noise.steps)
            for k, (to_x0, out_to_x0, x0_to_next, to_next, out_to_next, noise_to_next) in enumerate(rows):
                inputs = {
                    spec.sample_argument: x,
                    spec.timestep_argument: timesteps[k].expand(x.shape[0]),
                    **observations,
                }
                out = module(**inputs)
                x0 = to_x0 * x + out_to_x0 * out
                if table.clip is not None:
                    x0 = x0.clamp(-table.clip, table.clip)
                x = x0_to_next * x0 + to_next * x + out_to_next * out
                if noise_to_next and draws is not None:
                    x = x + noise_to_next * draws[k]
            return x

    return run
