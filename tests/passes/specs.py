"""Policy specifications for toy denoisers."""

import numpy as np

from ttscompile import ChunkSpec, ObservationSpec, PolicySpec, SamplerTable


def toy_spec(sample: tuple[int, int] = (4, 2), obs: tuple[int, ...] = (3,), steps: int = 5) -> PolicySpec:
    """A deterministic sampler that moves a tenth of the prediction a step."""
    ones = np.ones(steps, np.float32)
    table = SamplerTable(
        name="toy", timesteps=np.arange(steps)[::-1].copy(), sample_to_x0=ones, out_to_x0=-ones, x0_to_next=0 * ones,
        sample_to_next=ones, out_to_next=-0.1 * ones, noise_to_next=0 * ones, clip=None,
    )  # fmt: skip
    return PolicySpec(sample, {"obs": ObservationSpec(obs)}, table, ChunkSpec(sample[1], 0, sample[0]))
