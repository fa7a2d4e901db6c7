"""Run CogACT's action model on seeded weights, and write what it gives: ``cogact.npz``.

Not run by the tests. Needs a clone of microsoft/CogACT (b174a1b), and timm 0.9.10::

    pip install --no-deps --target timm-0.9.10 timm==0.9.10
    PYTHONPATH=timm-0.9.10 python -m tests.families.golden.make_cogact path/to/CogACT
"""

import sys
from functools import partial
from pathlib import Path
from unittest.mock import patch

import torch
from torch import nn

from .originals import Arrays, generator, normal, seeded, timm

SEED, BATCH, HORIZON, ACTIONS, COGNITION, GUIDANCE = 14, 2, 6, 5, 18, 1.5


def run(folder: Path) -> dict[str, Arrays]:
    """A guided prediction at two timesteps, and the actions of the guided DDIM loop, 10 of 100 steps."""
    timm("0.9.10")
    sys.path.insert(0, str(folder))
    from action_model import action_model

    tiny = partial(action_model.DiT, depth=2, hidden_size=24, num_heads=3)
    with patch.dict(action_model.DiT_models, {"tiny": tiny}):
        model = action_model.ActionModel(COGNITION, "tiny", ACTIONS, HORIZON - 1, 0)
    # The original builds it 4096 wide whatever the width of the token, and reads it from the checkpoint.
    model.net.z_embedder.uncondition = nn.Parameter(torch.zeros(1, COGNITION))
    seeded(model.net, SEED)
    draw = normal(114)
    cognition, noise = draw(BATCH, 1, COGNITION), draw(BATCH, HORIZON, ACTIONS)
    none = model.net.z_embedder.uncondition[None].expand(BATCH, 1, -1)
    both = torch.cat([torch.from_numpy(cognition), none], 0)
    sample = torch.cat([torch.from_numpy(noise)] * 2, 0)
    timesteps = torch.tensor([90, 30])
    predict = model.net.forward_with_cfg
    prediction = predict(sample, torch.cat([timesteps, timesteps]), both, GUIDANCE)
    actions = model.create_ddim(10).ddim_sample_loop(
        predict,
        sample.shape,
        sample,
        clip_denoised=False,
        model_kwargs={"z": both, "cfg_scale": GUIDANCE},
        progress=False,
        device="cpu",
        eta=0.0,
    )
    return {
        "cogact": {
            "seed": SEED,
            "cognition": cognition,
            "noise": noise,
            "timesteps": timesteps.numpy(),
            "prediction": prediction[:BATCH].numpy(),
            "actions": actions[:BATCH].numpy(),
        }
    }


main = generator(run, "b174a1b", "action_model")

if __name__ == "__main__":
    main()
