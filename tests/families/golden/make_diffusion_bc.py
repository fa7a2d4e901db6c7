"""Run Diffusion BC on seeded weights, and write what it gives: ``diffusion_bc.npz``.

Not run by the tests. Needs a clone of microsoft/Imitating-Human-Behaviour-w-Diffusion (41e75ef), and scikit-learn for
the choice of Diffusion-KDE::

    pip install --no-deps --target scikit-learn scikit-learn==1.9.1 joblib threadpoolctl scipy narwhals
    PYTHONPATH=scikit-learn python -m tests.families.golden.make_diffusion_bc path/to/clone
"""

import importlib
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import nn

from tests.policies import bc

from .originals import Arrays, generator

EXPERIMENTS = (1e-4, 0.02)
"""Their betas."""


def run(folder: Path) -> dict[str, Arrays]:
    """Of each variant a prediction at two timesteps, and the actions of ``sample`` and of ``sample_extra``."""
    sys.path.insert(0, str(folder / "code"))
    models: Any = importlib.import_module("models")
    arrays: Arrays = {}
    for variant in bc.VARIANTS:
        arrays |= {f"{variant}.{name}": value for name, value in of(models, variant).items()}
    for steps in sorted({sizes.timesteps for sizes in bc.VARIANTS.values()}):
        schedule = models.ddpm_schedules(*EXPERIMENTS, steps)
        arrays |= {f"schedule{steps}.{name}": value.numpy() for name, value in schedule.items()}
    drawn = np.random.default_rng(26).standard_normal((50, 3), dtype=np.float32) / 4
    density = importlib.import_module("sklearn.neighbors").KernelDensity(kernel="gaussian", bandwidth=0.1).fit(drawn)
    arrays |= {"kde.drawn": drawn, "kde.chosen": np.argmax(density.score_samples(drawn))}
    return {"diffusion_bc": arrays}


def of(models: Any, variant: str) -> Arrays:
    """What one policy gives."""
    sizes = bc.VARIANTS[variant]
    kind = "fc" if sizes.hidden else "transformer"
    if sizes.image is None:
        network = models.Model_mlp_diff_embed(
            sizes.state * sizes.times,
            sizes.hidden,
            sizes.actions,
            sizes.embedded,
            net_type=kind,
            use_prev=sizes.times == 2,
        )
    else:
        network = models.Model_cnn_mlp((32, 32, sizes.image[0]), sizes.hidden, sizes.actions, sizes.embedded, kind)
        narrow_images(models, network, sizes)
    if not sizes.hidden:
        narrow_tokens(models, network if sizes.image is None else network.nn_downstream, sizes)
    model = models.Model_Cond_Diffusion(network, EXPERIMENTS, sizes.timesteps, "cpu", sizes.state, sizes.actions)
    given = bc.weights(variant)
    left = model.load_state_dict(given, strict=False)
    schedule = set(models.ddpm_schedules(*EXPERIMENTS, sizes.timesteps))
    assert not left.unexpected_keys
    assert {name for name in left.missing_keys if not bc.counts(name)} == schedule, left.missing_keys
    model.eval()
    observed = torch.from_numpy(next(iter(bc.observation(variant).values())))
    if sizes.image is not None:
        observed = observed.permute(0, 2, 3, 1)  # channels last, as its data set has them
    noise = torch.from_numpy(bc.draws(variant))
    timesteps = torch.tensor([[sizes.timesteps], [1]])
    prediction = model.nn_model(noise[0], observed, timesteps / sizes.timesteps, torch.zeros(bc.STREAMS))
    result = {"prediction": prediction.numpy()}
    for name, call in (
        ("sample", lambda: model.sample(observed)),
        ("extra", lambda: model.sample_extra(observed, extra_steps=bc.EXTRA)),
    ):
        order = iter(noise)
        with patch("torch.randn", lambda *args, order=order, **kwargs: next(order).clone()):
            result[name] = call().numpy()
    return result


def narrow_images(models: Any, network: nn.Module, sizes: Any) -> None:
    """Its 64 features are a number in the code, and most of so small a network."""
    channels, features = sizes.image
    for name, before, after in (("conv_down1", channels, features), ("conv_down3", features, 2 * features)):
        layers = models.ResidualConvBlock(before, after, is_res=True), nn.MaxPool2d(2)
        setattr(network, name, nn.Sequential(*layers))
    kind = "fc" if sizes.hidden else "transformer"
    downstream = models.Model_mlp_diff_embed(sizes.state, sizes.hidden, sizes.actions, sizes.embedded, net_type=kind)
    network.nn_downstream = downstream


def narrow_tokens(models: Any, network: Any, sizes: Any) -> None:
    """So are its tokens of 64 numbers and 16 heads."""
    width, heads = sizes.tokens
    network.t_to_input, network.y_to_input, network.x_to_input = (nn.Linear(sizes.embedded, width) for _ in range(3))
    network.pos_embed = models.TimeSiren(1, width)
    for number in range(1, 5):
        setattr(network, f"transformer_block{number}", models.TransformerEncoderBlock(width, width * heads, heads))
    network.final = nn.Linear(width * (2 + sizes.times), sizes.actions)


main = generator(run, "41e75ef", "code/models.py")

if __name__ == "__main__":
    main()
