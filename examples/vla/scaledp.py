"""Compile ScaleDP, the action head of your own DexVLA policy: its ``model_forward``, as DexVLA has it.

The vision-language model runs once a call, with your code, and leaves one vector behind: ``action_hidden_states``,
which ``film_forward`` gives. That vector and the state of the robot are what the head observes.

    compile_head(model.policy_head, "compiled/")     # changes policy_head: load the policy again to train it

On the robot::

    head = ttscompile.load("compiled/")
    out = head.predict_action({"features": action_hidden_states.float().numpy(), "state": states.float().numpy()})
    actions = out["action_pred"]                     # normalised, [B, chunk, action_dim]
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

import ttscompile
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.samplers.table import sampler_table


class Waves(nn.Module):
    """In place of the head's ``t_embedder``: its waves as a table.

    They are bfloat16 whatever the weights are, and an artifact does not compute in bfloat16.

    Args:
        embedder: that of the head.
        timesteps: of its training.
    """

    waves: Tensor

    def __init__(self, embedder: Any, timesteps: int) -> None:
        super().__init__()
        self.mlp = embedder.mlp
        waves = embedder.timestep_embedding(torch.arange(timesteps), embedder.frequency_embedding_size)
        self.register_buffer("waves", waves.float(), persistent=False)

    def forward(self, timestep: Tensor) -> Tensor:
        """``[B] -> [B, width]``."""
        return self.mlp(self.waves[timestep.long()])


class Head(nn.Module):
    """``model_forward`` as a function of tensors.

    Args:
        head: DexVLA's ``ScaleDP``; it becomes float32, and gets the table.
    """

    def __init__(self, head: Any) -> None:
        super().__init__()
        self.head = head.float().eval()
        if not isinstance(head.t_embedder, Waves):
            head.t_embedder = Waves(head.t_embedder, head.noise_scheduler.config.num_train_timesteps)

    def forward(self, sample: Tensor, timestep: Tensor, features: Tensor, state: Tensor) -> Tensor:
        """The noise ``[B, T, D]``, from ``features [B, 1, cond_dim]`` and ``state [B, state_dim]``."""
        return self.head.model_forward(sample, timestep, features, state)


def compile_head(head: Any, directory: str | Path, **arguments: Any) -> Any:
    """Compile a ``ScaleDP`` with its own scheduler and its own number of steps.

    Args:
        head: ``policy_head`` of a DexVLA policy, on the CPU; see ``Head`` for what becomes of it.
        directory: where the artifact goes.
        arguments: further ones of ``ttscompile.compile_denoiser``.
    """
    config = head.config
    spec = PolicySpec(
        sample=(config.prediction_horizon, config.input_dim),
        observations={
            "features": ObservationSpec((1, config.cond_dim), window=False),
            "state": ObservationSpec((config.state_dim,)),
        },
        sampler=sampler_table(head.noise_scheduler, head.num_inference_timesteps, name="ddim"),
        chunk=ChunkSpec(config.output_dim, 0, config.prediction_horizon),
    )
    return ttscompile.compile_denoiser(Head(head), spec, directory, **arguments)
