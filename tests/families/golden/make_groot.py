"""Run GR00T N1.7's action head on seeded weights, and write what it gives: ``groot.npz``.

Not run by the tests. Needs a clone of huggingface/lerobot (7427f31)::

    python -m tests.families.golden.make_groot path/to/lerobot
"""

import importlib
from pathlib import Path

import torch

from .originals import Arrays, generator, lerobot, noise_from, normal, seeded

SEED, BATCH, HORIZON, ACTIONS, TOKENS, SOURCE, WIDTH, OUT = 13, 2, 6, 5, 9, 20, 24, 16


def run(folder: Path) -> dict[str, Arrays]:
    """The velocity at two timesteps, and the actions of ``get_action_with_features``, for the second embodiment."""
    lerobot(folder, "groot", "groot.action_head")
    original = importlib.import_module("lerobot.policies.groot.groot_n1_7")
    transformer = {
        "num_attention_heads": 3,
        "attention_head_dim": 8,
        "output_dim": OUT,
        "num_layers": 4,
        "positional_embeddings": None,
        "interleave_self_attention": True,
        "norm_type": "ada_norm",
        "final_dropout": True,
        "norm_elementwise_affine": False,
    }
    settings = original.GR00TN17Config(
        hidden_size=OUT,
        input_embedding_dim=WIDTH,
        backbone_embedding_dim=SOURCE,
        use_alternate_vl_dit=False,
        diffusion_model_cfg=transformer,
        vl_self_attention_cfg=None,
        max_action_dim=ACTIONS,
        max_state_dim=ACTIONS,
        max_num_embodiments=2,
        max_seq_len=10,
        action_horizon=HORIZON,
        num_inference_timesteps=4,
    )
    head = original.GR00TN17ActionHead(settings)
    # Hidden layers wider than its input, which the settings cannot say.
    head.action_decoder = original.CategorySpecificMLP(2, OUT, WIDTH, ACTIONS)
    seeded(head, SEED, "state_encoder.", "vlln.")
    draw = normal(113)
    features, state, noise = draw(BATCH, TOKENS, SOURCE), draw(BATCH, 1, WIDTH), draw(BATCH, HORIZON, ACTIONS)
    memory, start, second = torch.from_numpy(features), torch.from_numpy(state), torch.tensor([1, 1])
    timesteps = torch.tensor([0, 750])
    tokens = head.action_encoder(torch.from_numpy(noise), timesteps, second)
    tokens = tokens + head.position_embedding(torch.arange(HORIZON))
    velocity = head.action_decoder(head.model(torch.cat([start, tokens], 1), memory, timesteps), second)
    with noise_from(noise):
        actions = head.get_action_with_features(memory, start, second, None, {})["action_pred"]
    return {
        "groot": {
            "seed": SEED,
            "features": features,
            "state": state,
            "noise": noise,
            "timesteps": timesteps.numpy(),
            "velocity": velocity[:, -HORIZON:].numpy(),
            "actions": actions.numpy(),
        }
    }


main = generator(run, "7427f31", "src/lerobot")

if __name__ == "__main__":
    main()
