"""Run DiT-Policy's agent on seeded weights, and write what it gives: ``dit_policy.npz``.

Not run by the tests. Needs a clone of SudeepDasari/dit-policy (ba22ee3)::

    python -m tests.families.golden.make_dit_policy path/to/dit-policy
"""

import importlib
from pathlib import Path

import torch
from torch import Tensor, nn

from .originals import Arrays, generator, noise_from, normal, package, seeded

SEED, BATCH, HORIZON, ACTIONS, TOKENS, WIDTH = 15, 2, 6, 5, 7, 24


class _Tokens(nn.Module):
    """In place of a network of images: ``[B, 1, S, E]`` -> ``[B, S, E]``."""

    embed_dim, n_tokens = WIDTH, TOKENS

    def forward(self, images: Tensor) -> Tensor:
        return images[:, 0]


def run(folder: Path) -> dict[str, Arrays]:
    """A prediction at two timesteps, and the actions of ``get_actions``, 8 of 100 steps."""
    package("data4robotics", folder / "data4robotics")
    diffusion = importlib.import_module("data4robotics.models.diffusion")
    agent = diffusion.DiffusionTransformerAgent(
        features=_Tokens(),
        odim=0,
        n_cams=1,
        use_obs=False,
        ac_dim=ACTIONS,
        ac_chunk=HORIZON,
        train_diffusion_steps=100,
        eval_diffusion_steps=8,
        noise_net_kwargs={"time_dim": 16, "hidden_dim": WIDTH, "num_blocks": 2, "dim_feedforward": 40, "nhead": 3},
    ).eval()
    seeded(agent.noise_net, SEED, "enc_pos.pe")
    draw = normal(115)
    tokens, noise, timesteps = draw(BATCH, TOKENS, WIDTH), draw(BATCH, HORIZON, ACTIONS), torch.tensor([84, 12])
    _, prediction = agent.noise_net(torch.from_numpy(noise), timesteps, torch.from_numpy(tokens))
    with noise_from(noise):
        actions = agent.get_actions({"cam0": torch.from_numpy(tokens)[:, None]}, torch.zeros(BATCH, 0))
    return {
        "dit_policy": {
            "seed": SEED,
            "tokens": tokens,
            "noise": noise,
            "timesteps": timesteps.numpy(),
            "prediction": prediction.numpy(),
            "actions": actions.numpy(),
        }
    }


main = generator(run, "ba22ee3", "data4robotics")

if __name__ == "__main__":
    main()
