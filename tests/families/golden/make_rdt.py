"""Run RDT's runner on seeded weights, and write what it gives: ``rdt.npz``.

Not run by the tests. Needs a clone of thu-ml/RoboticsDiffusionTransformer (deb71d8), and timm 1.0.3::

    pip install --no-deps --target timm-1.0.3 timm==1.0.3
    PYTHONPATH=timm-1.0.3 python -m tests.families.golden.make_rdt path/to/RoboticsDiffusionTransformer
"""

import sys
from pathlib import Path

import numpy as np
import torch

from .originals import Arrays, generator, noise_from, normal, seeded, timm

SEED, BATCH, HORIZON, ACTIONS = 7, 2, 6, 5
LANGUAGE, IMAGE, HZ = 12, 10, (25.0, 10.0)
"""Width of the tokens, and the rate of control of each sample."""


def run(folder: Path) -> dict[str, Arrays]:
    """A prediction at two timesteps, and the actions of ``predict_action``; language of two lengths."""
    timm("1.0.3")
    sys.path.insert(0, str(folder))
    from models.rdt_runner import RDTRunner

    runner = RDTRunner(
        action_dim=ACTIONS,
        pred_horizon=HORIZON,
        config={
            "rdt": {"hidden_size": 32, "depth": 4, "num_heads": 4},
            "lang_adaptor": "mlp2x_gelu",
            "img_adaptor": "mlp2x_gelu",
            "state_adaptor": "mlp3x_gelu",
            "noise_scheduler": {
                "type": "ddpm",
                "num_train_timesteps": 1000,
                "num_inference_timesteps": 5,
                "beta_schedule": "squaredcos_cap_v2",
                "prediction_type": "sample",
                "clip_sample": False,
            },
        },
        lang_token_dim=LANGUAGE,
        img_token_dim=IMAGE,
        state_token_dim=ACTIONS,
        max_lang_cond_len=9,
        img_cond_len=8,
        dtype=torch.float32,
    )
    seeded(runner, SEED)
    draw = normal(8)
    language, image, state = draw(BATCH, 7, LANGUAGE), draw(BATCH, 8, IMAGE), draw(BATCH, 1, ACTIONS)
    language_mask = np.ones((BATCH, 7), bool)
    language_mask[1, 5:] = False
    action_mask = np.ones((BATCH, 1, ACTIONS), np.float32)
    action_mask[:, :, 4] = 0
    noise, timesteps, frequency = draw(BATCH, HORIZON, ACTIONS), np.array([999, 400]), np.array(HZ, np.float32)

    mask, rate, valid = torch.from_numpy(language_mask), torch.from_numpy(frequency), torch.from_numpy(action_mask)
    placed = torch.cat([torch.from_numpy(state), valid], 2)
    words, patches, start = runner.adapt_conditions(torch.from_numpy(language), torch.from_numpy(image), placed)
    tokens = runner.state_adaptor(torch.cat([torch.from_numpy(noise), valid.expand(-1, HORIZON, -1)], 2))
    tokens = torch.cat([start, tokens], 1)
    prediction = runner.model(tokens, rate, torch.from_numpy(timesteps), words, patches, lang_mask=mask)
    with noise_from(noise):
        actions = runner.predict_action(
            torch.from_numpy(language), mask, torch.from_numpy(image), torch.from_numpy(state), valid, rate
        )
    return {
        "rdt": {
            "seed": SEED,
            "lang_tokens": language,
            "lang_attn_mask": language_mask,
            "img_tokens": image,
            "state_tokens": state,
            "action_mask": action_mask,
            "ctrl_freqs": frequency[:, None],  # an observation has an axis besides the batch
            "noise": noise,
            "timesteps": timesteps,
            "prediction": prediction.numpy(),
            "actions": actions.numpy(),
        }
    }


main = generator(run, "deb71d8", "models")

if __name__ == "__main__":
    main()
