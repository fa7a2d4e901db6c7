"""Compile the Llama of your own Dita policy: its ``forward``, as Dita has it.

The networks of words and images run once a call, with your code. What they leave behind is the prefix: the tokens of
the words, then those of the frames, ``[B, P, E]``.

    compile_head(network, "compiled/", frames=2)     # a RobotTransformerNet with the weights of your checkpoint

On the robot::

    head = ttscompile.load("compiled/")
    images = network.image_tokenizer(image, words)   # words [B, frames, 77, E] as in obs["natural_language_embedding"]
    prefix = torch.cat([words[:, 0], images.flatten(1, 2)], 1)
    actions = head.predict_action({"prefix": prefix.float().numpy()})["action"]  # normalised, [B, chunk, D]
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor, nn
from torch.nn import functional

import ttscompile
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.samplers.table import sampler_table


class Head(nn.Module):
    """``forward`` of a ``RobotTransformerNet``, as a function of tensors.

    Dita evaluates its Llama on all tokens at every step. Attention is causal: no token sees those behind it. Here the
    prefix, the timestep and the actions go through it one after the other, each with the keys and values of those
    before. Then only the actions stay in the loop.

    Args:
        network: a ``RobotTransformerNet`` that denoises with its Llama and pads the actions to the width of a token.

    Raises:
        ValueError: it has another head (``use_action_head_diff``) or another way to a token (``dim_align_type``).
    """

    def __init__(self, network: Any) -> None:
        super().__init__()
        for setting in ("use_action_head_diff", "dim_align_type"):
            if found := getattr(network, setting):
                raise ValueError(f"{setting} of the network must be 0; found {found}. Write its forward into a Head.")
        self.llama, self.time = network.transformer, network.time_emb
        self.width = network.token_embedding_size

    def forward(self, sample: Tensor, timestep: Tensor, prefix: Tensor) -> Tensor:
        """The noise ``[B, T, D]``, from ``prefix [B, P, E]``."""
        past = None
        for before in (prefix, self.time(timestep)[:, None]):
            past = self.llama.model(inputs_embeds=before, past_key_values=past, use_cache=True).past_key_values
        actions = functional.pad(sample, (0, self.width - sample.shape[-1]))
        return self.llama(inputs_embeds=actions, past_key_values=past, use_cache=True).logits


def compile_head(network: Any, directory: str | Path, frames: int = 2, words: int = 77, **arguments: Any) -> Any:
    """Compile a Dita network with its own scheduler and its own number of steps.

    Args:
        network: ``RobotTransformerNet``, on the CPU; it becomes float32.
        directory: where the artifact goes.
        frames: that are observed; the actions before the last of them are not returned, as in ``inference``.
        words: length of an instruction in tokens, with its padding.
        arguments: further ones of ``ttscompile.compile_denoiser``.
    """
    horizon, actions = network.time_sequence_length, network.trajectory_dim
    prefix = words + frames * network.tokens_per_context_image
    spec = PolicySpec(
        sample=(horizon, actions),
        observations={"prefix": ObservationSpec((prefix, network.token_embedding_size), window=False)},
        sampler=sampler_table(network.noise_scheduler_eval, network.num_inference_steps, name="ddim"),
        chunk=ChunkSpec(actions, frames - 1, horizon),
    )
    return ttscompile.compile_denoiser(Head(network.float().eval()), spec, directory, **arguments)
