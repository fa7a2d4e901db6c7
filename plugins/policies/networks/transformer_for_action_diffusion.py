"""UMI's transformer, rebuilt: actions attend to the tokens of the observation and to that of the timestep.

Its layers are those of Diffusion Policy's transformer. Attribute names are those under which the weights of an original
checkpoint load as they are.

Source: ``TransformerForActionDiffusion`` of real-stanford/universal_manipulation_interface at d095ba9 (Chi et al.,
arXiv 2402.10329).
"""

import torch
from torch import nn

from .transformer_for_diffusion import Layers, SinusoidalEmbedding, TransformerConfig


class TransformerForActionDiffusion(nn.Module):
    """The denoiser: noisy sample, timestep and observation tokens to a prediction. Nothing is masked.

    Args:
        config: sizes; ``n_obs_steps`` is the number of the observation's tokens, which are ``n_emb`` wide.
    """

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        width = config.n_emb
        self.input_emb = nn.Linear(config.input_dim, width)
        self.pos_emb = nn.Parameter(torch.zeros(1, config.trunk_tokens, width))
        self.time_emb = SinusoidalEmbedding(width)
        self.cond_pos_emb = nn.Parameter(torch.zeros(1, config.memory_tokens, width))
        self.decoder = Layers(nn.TransformerDecoderLayer, config, config.n_layer)
        self.ln_f = nn.LayerNorm(width)
        self.head = nn.Linear(width, config.output_dim)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, cond: torch.Tensor) -> torch.Tensor:
        """``[B, T, input_dim]``, int64 ``[B]`` and float32 ``[B, tokens, n_emb]`` -> ``[B, T, output_dim]``."""
        memory = torch.cat((cond, self.time_emb(timestep).unsqueeze(1)), dim=1) + self.cond_pos_emb
        tokens = self.input_emb(sample) + self.pos_emb[:, : sample.shape[1]]
        return self.head(self.ln_f(self.decoder(tokens, memory)))  # type: ignore[no-any-return]
