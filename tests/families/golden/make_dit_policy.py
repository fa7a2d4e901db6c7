"""Run DiT-Policy's agent on seeded weights, and write what it gives: ``dit_policy.npz``, ``dit_policy_images.npz``.

Not run by the tests. Needs a clone of SudeepDasari/dit-policy (ba22ee3), and torchvision, of which no compiled part is
used::

    pip install --no-deps --target torchvision-0.28.0 torchvision==0.28.0
    PYTHONPATH=torchvision-0.28.0 python -m tests.families.golden.make_dit_policy path/to/dit-policy
"""

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ..weights import uniform_images
from .originals import Arrays, absent, generator, noise_from, normal, package, seeded

SEED, BATCH, HORIZON, ACTIONS, TOKENS, WIDTH = 15, 2, 6, 5, 7, 24
IMAGES_SEED, CAMERAS, STATE = 17, 2, 4


class _Tokens(nn.Module):
    """In place of a network of images: ``[B, 1, S, E]`` -> ``[B, S, E]``."""

    embed_dim, n_tokens = WIDTH, TOKENS

    def forward(self, images: Tensor) -> Tensor:
        return images[:, 0]


def _agent(diffusion: Any, features: nn.Module, width: int = WIDTH, **settings: Any) -> Any:
    return diffusion.DiffusionTransformerAgent(
        features=features,
        ac_dim=ACTIONS,
        ac_chunk=HORIZON,
        train_diffusion_steps=100,
        eval_diffusion_steps=8,
        noise_net_kwargs={"time_dim": 16, "hidden_dim": width, "num_blocks": 2, "dim_feedforward": 40, "nhead": 3},
        **settings,
    ).eval()


def run(folder: Path) -> dict[str, Arrays]:
    """A prediction at two timesteps, and the actions of ``get_actions``, 8 of 100 steps."""
    package("data4robotics", folder / "data4robotics")
    diffusion = importlib.import_module("data4robotics.models.diffusion")
    agent = _agent(diffusion, _Tokens(), odim=0, n_cams=1, use_obs=False)
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
        },
        "dit_policy_images": _on_images(diffusion),
    }


def _on_images(diffusion: Any) -> Arrays:
    """Actions of an agent with a ResNet for each of two cameras, and the tokens of one that is made otherwise."""
    root = Path(importlib.util.find_spec("torchvision").submodule_search_locations[0])  # type: ignore[union-attr,index]
    package("torchvision", root)
    package("torchvision.models", root / "models")
    networks = importlib.import_module("torchvision.models.resnet")
    sys.modules["torchvision.models"].__dict__.update(
        resnet18=networks.resnet18, ResNet18_Weights=networks.ResNet18_Weights
    )
    absent("r3m")
    resnet = importlib.import_module("data4robotics.models.resnet").ResNet
    see = importlib.import_module("data4robotics.transforms").get_transform_by_name("preproc")
    grouped = {"name": "group_norm", "num_groups": 16}
    agent = _agent(
        diffusion,
        resnet(18, grouped, avg_pool=False),
        odim=STATE,
        n_cams=CAMERAS,
        use_obs="add_token",
        feat_norm="layer_norm",
        token_dim=WIDTH,
    )
    seeded(agent, IMAGES_SEED, "noise_net.enc_pos.pe")
    draw = normal(116)
    noise, state = draw(BATCH, HORIZON, ACTIONS), draw(BATCH, STATE)
    pictures = torch.from_numpy(uniform_images(BATCH, CAMERAS, 256, seed=117))
    seen = {f"cam{i}": see(pictures[:, i])[:, None] for i in range(CAMERAS)}
    with noise_from(noise):
        actions = agent.get_actions(seen, torch.from_numpy(state))
    pooled = resnet(18, {"name": "diffusion_policy"}, avg_pool=True)
    other = _agent(diffusion, pooled, 516, odim=STATE, n_cams=1, use_obs="pad_img_tokens")
    seeded(other, IMAGES_SEED, "noise_net.")
    return {
        "seed": IMAGES_SEED,
        "state": state,
        "noise": noise,
        "actions": actions.numpy(),
        "padded_tokens": other.tokenize_obs({"cam0": seen["cam0"]}, torch.from_numpy(state)).numpy(),
    }


main = generator(run, "ba22ee3", "data4robotics")

if __name__ == "__main__":
    main()
