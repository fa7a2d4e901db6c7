"""Run ScaleDP, the action head of DexVLA, on seeded weights, and write what it gives: ``scaledp.npz``.

Not run by the tests. Needs a clone of juruobenruo/DexVLA (fc21a82), and timm 0.9.10::

    pip install --no-deps --target timm-0.9.10 timm==0.9.10
    PYTHONPATH=timm-0.9.10 python -m tests.families.golden.make_scaledp path/to/DexVLA
"""

import importlib
import itertools
import sys
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor, nn

from .originals import Arrays, generator, noise_from, normal, on_cpu, seeded, timm

SEED, BATCH, HORIZON, ACTIONS, STATE, CONDITION, HIDDEN = 16, 2, 6, 5, 4, 18, 20


def run(folder: Path) -> dict[str, Arrays]:
    """A prediction at two timesteps, and the actions of ``forward``, DDIM 10 of 100 steps."""
    timm("0.9.10")
    sys.path.insert(0, str(folder / "policy_heads"))
    settings = importlib.import_module("models.transformer_diffusion.configuration_scaledp")
    original = importlib.import_module("models.transformer_diffusion.modeling_scaledp")
    with patch.dict(settings.MODEL_STRUCTURE, {"tiny": {"depth": 2, "n_emb": 24, "num_heads": 3}}):
        config = settings.ScaleDPPolicyConfig(
            model_size="tiny",
            action_dim=ACTIONS,
            cond_dim=CONDITION,
            state_dim=STATE,
            prediction_horizon=HORIZON,
            num_inference_timesteps=10,
        )
    model = original.ScaleDP(config)
    # Its layers of the observation are 1,024 wide whatever the settings are, far wider than this network.
    widths = (CONDITION + STATE, HIDDEN, HIDDEN, CONDITION)
    first, second, third = (nn.Linear(n, m) for n, m in itertools.pairwise(widths))
    model.combine = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), third)
    seeded(model, SEED)
    waves = original.TimestepEmbedder.timestep_embedding

    def single(t: Tensor, dim: int) -> Tensor:
        """The original's waves, which are bfloat16 whatever the weights are."""
        return waves(t, dim).float()

    draw = normal(116)
    features, state, noise = draw(BATCH, 1, CONDITION), draw(BATCH, STATE), draw(BATCH, HORIZON, ACTIONS)
    condition, states, timesteps = torch.from_numpy(features), torch.from_numpy(state), torch.tensor([90, 30])
    with patch.object(original.TimestepEmbedder, "timestep_embedding", staticmethod(single)):
        prediction = model.model_forward(torch.from_numpy(noise), timesteps, condition, states)
        with noise_from(noise), on_cpu():
            actions = model(None, condition, states, None)
    return {
        "scaledp": {
            "seed": SEED,
            "features": features,
            "state": state,
            "noise": noise,
            "timesteps": timesteps.numpy(),
            "prediction": prediction.numpy(),
            "actions": actions.numpy(),
        }
    }


main = generator(run, "fc21a82", "policy_heads")

if __name__ == "__main__":
    main()
