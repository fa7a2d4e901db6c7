"""Policies with the preconditioning of EDM, as k-diffusion trains them (BESO, MDT): a module and its table of numbers.

Their denoised sample is ``c_skip(sigma) x + c_out(sigma) F(c_in(sigma) x, sigma)``. The path past F would hide its
residual stream; but all of it is linear, so that F alone is the denoiser, and the table does the rest, exactly.

Source: Karras et al., arXiv 2206.00364, table 1, and Euler's method, which is DDIM in these variables.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from ..core.coercion import numbers
from ..core.spec import SamplerTable
from ..errors import SpecError
from .flow import deterministic_table


class EDMDenoiser(nn.Module):
    """F as ``compile_denoiser`` takes it: ``forward(sample, timestep, **observations)``, the timestep being sigma.

    The sample of the table is the noise at the first step, and ``c_in x`` at the others. F is called as k-diffusion's
    ``Denoiser`` calls it: ``network(scaled, sigma, **observations)``, ``scaled [B, T, D]`` = ``c_in x``, ``sigma [B]``.
    """

    def __init__(self, network: nn.Module, sigmas: Sequence[float], sigma_data: float) -> None:
        super().__init__()
        self.network = network
        self.first = float(np.float32(sigmas[0]))
        self.first_scale = float(sigmas[0] / np.hypot(sigmas[0], sigma_data))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, **observations: torch.Tensor) -> torch.Tensor:
        """``[B, T, D]``, ``[B]`` -> ``[B, T, D]``."""
        scale = torch.where(timestep == self.first, self.first_scale, 1.0)
        return self.network(scale[:, None, None] * sample, timestep, **observations)  # type: ignore[no-any-return]


def edm_table(sigmas: Sequence[float], sigma_data: float, *, clip: float | None = None) -> SamplerTable:
    """The deterministic denoising loop of a policy with EDM's preconditioning, for ``EDMDenoiser``.

    Args:
        sigmas: the K + 1 noise levels, falling; the last is usually 0. k-diffusion's ``get_sigmas_exponential`` and
            ``get_sigmas_karras`` give them.
        sigma_data: standard deviation of the actions that the policy was trained with, as in its configuration.
        clip: bound on the denoised sample.

    Raises:
        SpecError: no noise levels, or such that do not fall to 0 or above it; ``sigma_data`` is not positive.
    """
    levels = numbers(sigmas, "sigmas", SpecError, "float64")
    if levels.ndim != 1 or len(levels) < 2 or not (np.isfinite(levels).all() and (np.diff(levels) < 0).all()):
        raise SpecError(f"EDM's noise levels must fall, and be two or more; found {levels.tolist()}.")
    if levels[-1] < 0 or not (np.isfinite(sigma_data) and sigma_data > 0):
        raise SpecError(f"noise levels and sigma_data must not be negative; found {levels[-1]} and {sigma_data}.")
    sigma, ratio = levels[:-1], levels[1:] / levels[:-1]
    deviation = np.hypot(sigma, sigma_data)
    # The sample of a row is x / unit: noise at first, c_in x then, and after the last row x itself.
    unit = np.concatenate([sigma[:1], deviation[1:]])
    next_unit = np.append(unit[1:], 1.0)
    return deterministic_table(
        "edm",
        sigma,
        clip,
        sample_to_x0=sigma_data**2 / deviation**2 * unit,
        out_to_x0=sigma * sigma_data / deviation,
        x0_to_next=(1 - ratio) / next_unit,
        sample_to_next=ratio * unit / next_unit,
    )
