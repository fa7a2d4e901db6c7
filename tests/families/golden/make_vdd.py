"""Run VDD, a mixture of experts distilled from a diffusion policy, on seeded weights: ``vdd.npz``.

Not run by the tests. Needs a clone of intuitive-robots/vdd (e1395f3), and einops::

    pip install --no-deps --target einops einops
    PYTHONPATH=einops python -m tests.families.golden.make_vdd path/to/vdd
"""

import importlib
import sys
from pathlib import Path

import numpy as np
import torch

from .originals import Arrays, generator, normal, seeded

SEED, OBSERVATION, ACTION, EXPERTS, WINDOW, EPISODES, CALLS = 21, 5, 3, 4, 4, 3, 8


def run(folder: Path) -> dict[str, Arrays]:
    """What ``act`` gives, with the choice of the best expert, once as many frames were seen as it looks at."""
    sys.path.insert(0, str(folder))
    backbone = importlib.import_module("vdd.networks.gpt").GPTNetwork(
        obs_dim=OBSERVATION,
        goal_dim=OBSERVATION,
        output_dim=16,
        embed_dim=24,
        embed_pdrop=0.0,
        atten_pdrop=0.1,
        resid_pdrop=0.1,
        n_layers=2,
        n_heads=3,
        window_size=WINDOW,
        goal_conditional=True,
        goal_seq_len=2,
        device="cpu",
    )
    model = importlib.import_module("vdd.networks.moes").GaussianMoE(
        num_components=EXPERTS,
        obs_dim=OBSERVATION,
        act_dim=ACTION,
        goal_dim=OBSERVATION,
        prior_type="uniform",
        cmp_init="orthogonal",
        cmp_cov_type="full",
        backbone=backbone,
        cmp_mean_hidden_dims=16,
        cmp_cov_hidden_dims=16,
        cmp_activation="mish",
        learn_gating=True,
        gating_hidden_layers=2,
        gating_hidden_dims=8,
        greedy_predict=True,
        device="cpu",
    )
    # Masks are no weights, and the spread of an expert takes no part in what it does.
    masks = [name for name in model.state_dict() if name.endswith(".mask")]
    seeded(model, SEED, *masks, "gmm_cov_net")
    chosen = list[int]()
    model.gating_network.register_forward_hook(lambda _, __, gates: chosen.append(int(gates[0, -1].argmax())))
    draw = normal(121)
    frames, goals = draw(EPISODES, CALLS, OBSERVATION), draw(EPISODES, 2, OBSERVATION)
    windows, actions = [], []
    for episode, goal in zip(torch.from_numpy(frames), torch.from_numpy(goals), strict=True):
        model.reset()
        given = [model.act(frame[None], goal).numpy() for frame in episode]
        actions += given[WINDOW - 1 :]
        windows += [episode[k - WINDOW + 1 : k + 1].numpy() for k in range(WINDOW - 1, CALLS)]
    return {
        "vdd": {
            "seed": SEED,
            "window": np.stack(windows),
            "goal": np.repeat(goals, CALLS - WINDOW + 1, axis=0),
            "actions": np.stack(actions),
            "chosen": np.array(chosen).reshape(EPISODES, CALLS)[:, WINDOW - 1 :].flatten(),
        }
    }


main = generator(run, "e1395f3", "vdd")

if __name__ == "__main__":
    main()
