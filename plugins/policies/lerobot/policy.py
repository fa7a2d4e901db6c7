"""What is around the network of every LeRobot policy: its observations, its sampler, its chunk and its weights."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import nn

from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec, Relative
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.loops import Loops
from ttscompile.frontends.saved_weights import as_float32, left_out, read_tensors, require_memory
from ttscompile.frontends.scheduler import MOST_STEPS, configured_loops
from ttscompile.frontends.settings import Settings

from ..networks.image_geometry import ResizeCrop
from .config import ACTION, CONFIG, STATE, WEIGHTS, LeRobotConfig
from .lora import find_base, merged, read_adapter
from .processors import Normalizer, Processors

TOKENS, MASK = "observation.language.tokens", "observation.language.attention_mask"
_SCHEDULER_SETTINGS = {
    "num_train_timesteps": 100,
    "beta_start": 0.0001,
    "beta_end": 0.02,
    "beta_schedule": "squaredcos_cap_v2",
    "clip_sample": True,
    "clip_sample_range": 1.0,
}


class Measured(nn.Module):
    """Base of the encoders of conditions: what the robot measures to what lerobot hands to a policy's network."""

    def __init__(self, config: LeRobotConfig, processors: Processors, geometry: ResizeCrop | None) -> None:
        super().__init__()
        self.names = {key: processors.renamed.get(key, key).replace(".", "_") for key in config.features}
        del self.names[ACTION]
        self.cameras, self.geometry = tuple(config.cameras), geometry
        self.normalizers = nn.ModuleList(Normalizer(processors.normalizers.get(key)) for key in self.names)

    def measured(self, observations: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """By the policy's names: vectors ``[B, To, D]``, and of each camera ``[B * To, 3, H, W]``, cropped."""
        found = {}
        for (key, name), normalizer in zip(self.names.items(), self.normalizers, strict=True):
            value = observations[name]
            if key in self.cameras:
                value = value.flatten(0, 1)
                # Normalised after the crop: pixels that nobody sees need no arithmetic.
                value = value if self.geometry is None else self.geometry(value)
            found[key] = normalizer(value)
        return found


def policy_spec(
    config: LeRobotConfig,
    processors: Processors,
    loops: Loops,
    source: Mapping[str, str],
    more: Mapping[str, ObservationSpec] | None = None,
) -> PolicySpec:
    """The specification of a policy."""
    start = config.n_obs_steps - 1
    relative = Relative(processors.renamed.get(STATE, STATE), processors.relative, processors.poses)
    return PolicySpec(
        sample=(config.horizon, config.action_dim),
        observations=_observations(config, processors) | dict(more or {}),
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(
            action_dim=config.action_dim,
            start=start,
            stop=min(start + config.n_action_steps, config.horizon),
            normalizer=None if processors.action is None else processors.action.inverse(config.horizon),
            ranged=processors.action is not None and processors.action.mode == "MIN_MAX",
            relative=relative if {*relative.columns} - {None} else None,
        ),
        source={"format": "lerobot", **source, **loops.source},
    )


def _observations(config: LeRobotConfig, processors: Processors) -> dict[str, ObservationSpec]:
    """What the robot gives, under its own names; images as float32 of 0..1, channels first."""
    specs = {}
    for key, (kind, shape) in config.features.items():
        if kind == "ACTION":
            continue
        statistics, whole = processors.normalizers.get(key), (config.n_obs_steps, *shape)
        usual = None if statistics is None or kind == "VISUAL" else statistics.usual_range
        bounds = (0.0, 1.0) if kind == "VISUAL" else usual
        specs[processors.renamed.get(key, key)] = ObservationSpec(whole, bounds=bounds)
    return specs


def language_inputs(tokens: int, vocabulary: int) -> dict[str, ObservationSpec]:
    """The instruction, as tokens."""
    return {
        TOKENS: ObservationSpec((tokens,), dtype="int64", window=False, bounds=(0.0, float(vocabulary - 1))),
        MASK: ObservationSpec((tokens,), dtype="bool", window=False, bounds=(0.0, 1.0)),
    }


def diffusion_loops(config: LeRobotConfig, options: LoadOptions) -> Loops:
    """The denoising loops of a policy that was trained with diffusion; the defaults are lerobot's."""
    settings = config.settings.values
    scheduler = {key: settings.get(key, default) for key, default in _SCHEDULER_SETTINGS.items()}
    scheduler["_target_"] = f"{config.settings.choice('noise_scheduler_type', 'DDPM', 'DDIM')}Scheduler"
    scheduler["prediction_type"] = config.settings.choice("prediction_type", "epsilon", "sample")
    where = str(config.directory / CONFIG)
    return configured_loops(scheduler, settings.get("num_inference_steps"), options, where=where)


def integration_steps(settings: Settings, options: LoadOptions, name: str, default: int) -> int:
    """Of flow matching: steps that the entry ``name`` says, or that are asked for in their place."""
    if options.spacing is not None:
        raise SpecError("spacing is of the timesteps of diffusion; this policy's objective is flow matching.")
    count = options.steps if options.steps is not None else settings.values.get(name, default)
    if type(count) is not int or not 1 <= count <= MOST_STEPS:
        raise SpecError(f"{settings.where}{count!r:.80} integration steps ({name}, --steps); expected 1-{MOST_STEPS}.")
    return count


def read_weights(config: LeRobotConfig, options: LoadOptions, *without: str) -> dict[str, torch.Tensor]:
    """The weights of a policy as float32, an adapter merged into its base; without those ``left_out``."""
    adapter, directory = read_adapter(config.directory, config.settings), config.directory
    if adapter is None and options.base is not None:
        raise CheckpointError(f"{directory}: the option base is for an adapter; found a whole policy. Leave it out.")
    weights = weights_in(directory if adapter is None else find_base(adapter, options.base), *without)
    return weights if adapter is None else merged(directory, adapter, weights, without)


def weights_in(directory: Path, *without: str) -> dict[str, torch.Tensor]:
    """The weights in a directory as float32, without those ``left_out``."""
    path = directory / WEIGHTS
    require_memory(path, without)
    saved = {name: value for name, value in read_tensors(path).items() if not left_out(name, without)}
    return as_float32(saved, f"{path}: ")
