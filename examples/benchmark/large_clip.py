"""LeRobot's ``multi_task_dit``, of real size, random weights, for ``large.py``: CLIP B/16, two cameras and frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import process_time

import numpy as np
import torch
from large_smolvla import call
from torch import nn

from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.policies.networks.clip import RELEASED, TextConfig, VisionConfig
from ttscompile.policies.networks.multi_task_dit import DiffusionTransformer, DiTConfig, ObservationEncoder
from ttscompile.samplers.flow import flow_matching_table

CAMERAS, FRAMES, STATE, WIDTH, STEPS, HORIZON, ACTIONS, TOKENS = ("front", "wrist"), 2, 14, 512, 100, 32, 14, 77


class Encoder(nn.Module):
    """Observations to the condition vector; the instruction is an observation, as LeRobot has it."""

    def __init__(self) -> None:
        super().__init__()
        clip = RELEASED["openai/clip-vit-base-patch16"]
        towers = VisionConfig(**clip["vision_config"]), TextConfig(**clip["text_config"])
        self.encoder = ObservationEncoder(len(CAMERAS), *towers, WIDTH, separate=False, frames=FRAMES)

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """``[B, C]``."""
        images = [observations[name].flatten(0, 1) for name in CAMERAS]
        encoded: torch.Tensor = self.encoder(
            observations["state"], images, observations["tokens"], observations["tokens_mask"]
        )
        return encoded


def policy() -> tuple[EncodedDenoiser, PolicySpec]:
    """The policy; the same weights every time."""
    torch.manual_seed(0)
    encoder = Encoder()
    frame = STATE + len(CAMERAS) * 768 + WIDTH
    config = DiTConfig(ACTIONS, HORIZON, WIDTH, 6, 8, 256, use_positional_encoding=False, use_rope=True, rope_base=1e4)
    denoiser = DiffusionTransformer(config, FRAMES * frame)
    with torch.no_grad():
        for name, weight in [*encoder.named_parameters(), *denoiser.named_parameters()]:
            if weight.ndim > 1:
                weight.normal_(
                    0, 0.02 if "embedding.weight" in name and weight.ndim == 2 else weight[0].numel() ** -0.5
                )
    images = {name: ObservationSpec((FRAMES, 3, 224, 224)) for name in CAMERAS}
    tokens = ObservationSpec((TOKENS,), dtype="int64", window=False, bounds=(0.0, 49407.0))
    mask = ObservationSpec((TOKENS,), dtype="bool", window=False, bounds=(0.0, 1.0))
    spec = PolicySpec(
        sample=(HORIZON, ACTIONS),
        observations={**images, "state": ObservationSpec((FRAMES, STATE)), "tokens": tokens, "tokens_mask": mask},
        sampler=flow_matching_table(STEPS),
        chunk=ChunkSpec(ACTIONS, 0, 8),
    )
    return EncodedDenoiser(encoder, denoiser).eval(), spec


def eager(
    module: EncodedDenoiser, spec: PolicySpec, clock: Callable[[], float] = process_time
) -> Callable[[], tuple[np.ndarray, list[float]]]:
    """A call in eager PyTorch: the actions; and the seconds, by ``clock``, of encoder and loop."""
    obs, noise = call(spec)
    given = {key: torch.from_numpy(value) for key, value in obs.items()}

    @torch.inference_mode()
    def run() -> tuple[np.ndarray, list[float]]:
        start = clock()
        encoded = module.encoder(given)
        between = clock()
        x = torch.from_numpy(noise.initial)
        for t in spec.sampler.timesteps:
            x = x + module.denoiser(x, torch.full((1,), float(t)), encoded) / STEPS
        return x.numpy()[:, :8], [between - start, clock() - between]

    return run
