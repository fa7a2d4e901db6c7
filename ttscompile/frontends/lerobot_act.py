"""LeRobot's ``act``: its directory to module and ``PolicySpec``.

It is no diffusion policy: one evaluation gives the chunk, and a loop of one step has nothing to reuse. Normalisers are
part of the module, so that the compiled policy takes what the robot measures.

Source: ``ACTPolicy.predict_action_chunk`` of huggingface/lerobot 0.6, and its processors.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ..core.spec import PolicySpec
from ..errors import CheckpointError
from ..samplers.table import DirectDenoiser, direct_table
from .act import ACT, ACTConfig
from .families import LoadOptions
from .lerobot_config import ENVIRONMENT, MOST, STATE, LeRobotConfig, read_lerobot_config
from .lerobot_policy import Measured, policy_spec, read_weights
from .lerobot_processors import Processors, read_processors
from .loops import Loops
from .resnet import DEPTHS
from .saved_weights import require_weights

_MOST_LAYERS = 256
_VECTORS = {STATE: "robot", ENVIRONMENT: "env"}
_COUNTER, _PREFIX = ".num_batches_tracked", "model."
_ONLY_TRAINED = f"{_PREFIX}vae_encoder"
"""Begins the names of what lerobot evaluates in training alone."""


def read_config(directory: Path, entries: Mapping[str, Any]) -> tuple[LeRobotConfig, ACTConfig]:
    """Check ``config.json``, of which these are the entries; defaults are lerobot's."""
    shared = read_lerobot_config(
        directory, entries, horizon=100, n_action_steps=100, environment=True, chunked=True, stateless=True
    )
    settings, widths = shared.settings, {key: shape[0] for key, (_, shape) in shared.features.items()}
    if not shared.cameras and ENVIRONMENT not in widths:
        raise settings.error(f"input_features have neither a camera nor {ENVIRONMENT!r}, of which act needs one")
    if settings.number("n_obs_steps", 1) != 1:
        raise settings.refusal("n_obs_steps", "1, as lerobot has it")
    backbone = str(settings.values.get("vision_backbone", "resnet18"))
    dilated = settings.values.get("replace_final_stride_with_dilation", 0)  # lerobot declares it as a number
    if shared.cameras and (backbone not in DEPTHS or dilated):
        found = f"vision_backbone is {backbone!r:.80}, replace_final_stride_with_dilation {dilated!r:.80}"
        raise CheckpointError(
            f"{settings.where}{found}; expected {' or '.join(DEPTHS)}, and false. Build the network with lerobot and"
            " use ttscompile.compile_denoiser(ttscompile.DirectDenoiser(network), spec)."
        )
    width, heads = settings.number("dim_model", 512, MOST), settings.number("n_heads", 8, MOST)
    if width % heads or (shared.cameras and width % 4):
        raise settings.refusal("dim_model", f"a multiple of n_heads = {heads}, and of 4 with cameras", 512)
    return shared, ACTConfig(
        chunk_size=shared.horizon,
        action_dim=shared.action_dim,
        vectors={name: widths[key] for key, name in _VECTORS.items() if key in widths},
        vision_backbone=backbone if shared.cameras else None,
        dim_model=width,
        n_heads=heads,
        dim_feedforward=settings.number("dim_feedforward", 3200, MOST),
        n_encoder_layers=settings.number("n_encoder_layers", 4, _MOST_LAYERS),
        n_decoder_layers=settings.number("n_decoder_layers", 1, _MOST_LAYERS),
        latent_dim=settings.number("latent_dim", 32, MOST),
        gelu=settings.choice("feedforward_activation", "relu", "gelu") == "gelu",
        pre_norm=settings.flag("pre_norm", False),
    )


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared, config = read_config(directory, entries)
    for name in ("task", "encoders", "without_cameras", "sampler", "steps", "spacing"):
        if getattr(options, name) is not None:
            raise CheckpointError(
                f"{directory}: the option {name} is for other types of policies; this one, act, gives its actions in"
                " one evaluation, is given no instruction and needs all its cameras. Leave it out."
            )
    if shared.settings.values.get("temporal_ensemble_coeff") is not None:
        warnings.warn(
            f"{shared.settings.where}temporal_ensemble_coeff is set, and select_action does no temporal ensembling: it"
            f" takes the first {shared.n_action_steps} of a chunk's actions from a queue. The executor does it, with"
            " ExecutorSettings(seam='ensemble', horizon=1). Otherwise set the coefficient to null, and n_action_steps"
            " to as many as are to be executed.",
            stacklevel=6,
        )
    processors = read_processors(directory, shared.features)
    read = read_weights(shared, options, _COUNTER)
    weights = {name: value for name, value in read.items() if not name.startswith(_ONLY_TRAINED)}
    try:
        # Compared before anything of the configured sizes is made, so that no more memory is taken than the file has.
        with torch.device("meta"):
            expected = as_saved(ACT(config))
        require_weights(expected, weights, "config.json")
    except CheckpointError as error:
        raise CheckpointError(f"{directory}: {error}") from error
    network = ACT(config)
    for name, value in as_saved(network).items():
        value.copy_(weights[name])
    module = DirectDenoiser(_Observing(shared, processors, network))
    source = {"policy": "act"} | ({"encoder": config.vision_backbone} if config.vision_backbone else {})
    return module.eval(), policy_spec(shared, processors, Loops(direct_table()), source)


def as_saved(network: ACT) -> dict[str, torch.Tensor]:
    """The weights of a network, not copied, under lerobot's names."""
    return {_PREFIX + name: value for name, value in network.state_dict().items() if not name.endswith(_COUNTER)}


class _Observing(Measured):
    """Raw observations to normalised actions: the network, and the normalisers before it."""

    def __init__(self, config: LeRobotConfig, processors: Processors, network: ACT) -> None:
        super().__init__(config, processors, None)
        self.network = network

    def forward(self, **observations: torch.Tensor) -> torch.Tensor:
        """Observations ``[B, 1, ...]`` by name -> ``[B, T, Da]``."""
        measured = self.measured(observations)
        images = [measured.pop(key) for key in self.cameras]
        vectors = {name: measured[key][:, 0] for key, name in _VECTORS.items() if key in measured}
        return self.network(vectors, images)  # type: ignore[no-any-return]
