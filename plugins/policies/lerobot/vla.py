"""What LeRobot's vision-language-action models have in common: cameras, instruction, state, and the loop.

Sources: ``lerobot.policies.common`` of huggingface/lerobot 0.6, and openpi, where it is from.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.core.spec import (
    COMMITTED,
    LARGEST,
    WITHOUT,
    Instruction,
    ObservationSpec,
    PolicySpec,
    SamplerTable,
    Switch,
)
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.loops import Make, loops_of
from ttscompile.frontends.settings import Settings
from ttscompile.samplers.flow import METHODS, flow_matching_table

from ..networks.language_layers import LanguageConfig
from .config import MOST, STATE, LeRobotConfig, read_lerobot_config
from .policy import MASK, TOKENS, integration_steps, language_inputs, policy_spec
from .processors import Normalizer, Processors, read_processors

Fit = Literal["start", "centre", "bytes", "stretch", "average"]
"""Of images, see ``ObservationSpec``."""
_EMPTY = "observation.images.empty_camera_"
"""How lerobot calls a camera that the checkpoint knows and no robot has."""


def read_vla_config(
    directory: Path, entries: Mapping[str, Any], options: LoadOptions, stateless: bool = False
) -> LeRobotConfig:
    """Check what all of them have; cameras that the robot lacks are left out.

    LeRobot shows the network a black image for such a camera, and masks it: nothing reads it. ``stateless`` says
    whether a policy may be without state.
    """
    config = read_lerobot_config(directory, entries, horizon=50, n_action_steps=50, chunked=True, stateless=stateless)
    if config.settings.flag("adapt_to_pi_aloha", False):
        raise config.settings.error(
            "adapt_to_pi_aloha is set: lerobot turns joints into others that are normalised already, which is not"
            " compiled; expected false"
        )
    if entries["type"] != "pi05" and config.settings.values.get("rtc_training_max_delay", 0) != 0:
        raise config.settings.error(
            "rtc_training_max_delay is set: the policy was trained to go on from a clean prefix, which is compiled of"
            " pi05 alone; with 0 it is compiled as a policy that knows no prefix"
        )
    if config.settings.flag("use_visual_memory", False) or config.settings.flag("use_proprioceptive_memory", False):
        raise config.settings.error(
            "use_visual_memory or use_proprioceptive_memory is set: the policy reads frames of seconds before, which"
            " is not compiled; expected false"
        )
    kept = kept_cameras(directory, config.cameras, options)
    features = {key: each for key, each in config.features.items() if key in kept or key not in config.cameras}
    return replace(config, features=features)


def kept_cameras(directory: Path, cameras: Collection[str], options: LoadOptions) -> list[str]:
    """The cameras without those that the robot lacks."""
    without = set(options.without_cameras or ())
    unknown = sorted(without - set(cameras))
    kept = [key for key in cameras if not key.startswith(_EMPTY) and key not in without]
    if unknown or not kept:
        told = f"the cameras are {', '.join(cameras) or 'none'}; {', '.join(unknown) or 'all'} cannot be left out"
        raise CheckpointError(f"{directory}: {told}. A policy needs a camera that it was trained with.")
    return kept


def read_vla_processors(config: LeRobotConfig) -> tuple[LeRobotConfig, Processors]:
    """The processors of a policy, which leave images alone but in steps that its type alone has.

    The configuration comes back with the width that the state of this robot has.
    """
    processors = read_processors(config.directory, config.features, str(config.settings.values["type"]))
    normalised = sorted(key for key in config.cameras if key in processors.normalizers)
    if normalised:
        raise CheckpointError(
            f"{config.directory}: {', '.join(normalised[:4])} is normalised before it is resized; expected images as"
            " they are (VISUAL: IDENTITY), which all vision-language-action models of lerobot have."
        )
    if processors.state_dim is not None:
        config = replace(config, features={**config.features, STATE: ("STATE", (processors.state_dim,))})
    return config, processors


def vla_spec(
    config: LeRobotConfig,
    processors: Processors,
    image: tuple[int, int] | None,
    fit: Fit,
    sizes: Mapping[str, int],
    options: LoadOptions,
    table: Make | None = None,
    told: Instruction | None = None,
) -> PolicySpec:
    """The specification of a policy.

    Args:
        image: height and width that images are resized to; None where they stay.
        fit: where the rest of a resized image is.
        sizes: ``actions``, the padded width of the sample; ``tokens`` of the instruction, and ``vocabulary``.
        table: the loop; None for ten steps, or as many as are configured, from time 1 to time 0.
        told: how a task becomes tokens; None as the processors say.
    """
    language = language_inputs(sizes["tokens"], sizes["vocabulary"]) if options.task is None else {}
    source = {"policy": str(config.settings.values["type"])}
    source |= {} if options.task is None else {"task": options.task}
    source |= {WITHOUT: ", ".join(options.without_cameras)} if options.without_cameras else {}
    loops = loops_of(table or (lambda each: _sampler(config.settings, each)), options, "its own integration")
    if config.settings.flag("use_relative_actions", False) and not processors.relative:
        raise config.settings.error("use_relative_actions is set, and no step around the policy adds the state to them")
    spec = policy_spec(config, processors, loops, source, language)
    observations = dict(spec.observations)
    if image is not None:
        resized = ObservationSpec((1, 3, *image), bounds=(0.0, 1.0), fit=fit)
        observations |= {processors.renamed.get(key, key): resized for key in config.cameras}
    read = told or Instruction(TOKENS, MASK, processors.new_line) if language else None
    sample = (config.horizon, sizes["actions"])
    return replace(spec, sample=sample, observations=observations, instruction=read)


def _sampler(settings: Settings, options: LoadOptions) -> SamplerTable:
    name = "num_steps" if "num_steps" in settings.values else "num_inference_steps"
    return flow_matching(integration_steps(settings, options, name, 10), options, start=1.0, end=0.0)


def in_buckets(settings: Settings, steps: int, last: int, clipped: bool, options: LoadOptions) -> SamplerTable:
    """From noise at time 0 to actions at 1, each time as a whole number up to ``last``, rounded down as lerobot does.

    Args:
        steps: where neither the configuration nor the options say how many.
        clipped: whether actions are clipped to -1..1 after the last step.
    """
    count = integration_steps(settings, options, "num_inference_timesteps", steps)
    table = flow_matching(count, options, start=0.0, end=1.0)
    times = np.rint(table.timesteps.astype(np.float64) * 2 * count) / (2 * count)  # as they were before float32
    table = replace(table, timesteps=(times * last).astype(np.int64))
    return _clipped_at_the_end(table) if clipped else table


def _clipped_at_the_end(table: SamplerTable) -> SamplerTable:
    if table.name != "euler":
        raise SpecError(f"sampler {table.name}: the actions of this policy are clipped at the end; expected euler.")
    last = np.arange(table.steps) == table.steps - 1
    share = {"x0_to_next": last, "sample_to_next": ~last, "out_to_next": np.where(last, 0, table.out_to_next)}
    return replace(table, clip=1.0, **{name: each.astype(np.float32) for name, each in share.items()})


def flow_matching(count: int, options: LoadOptions, start: float, end: float) -> SamplerTable:
    """So many steps from noise at ``start`` to actions at ``end``, by Euler's method unless another is asked for."""
    if options.sampler not in (None, *METHODS):
        raise SpecError(f"sampler {options.sampler!r} is of diffusion; expected {' or '.join(METHODS)} of this policy.")
    return flow_matching_table(count, options.sampler or "euler", start=start, end=end)


def padded_size(settings: Settings, name: str, own: int, default: int = 32) -> int:
    """The width that states or actions are padded to, which has to hold the robot's own."""
    size = settings.number(name, default, MOST)
    if own > size:
        raise settings.refusal(name, f"at least the {own} numbers that the robot has", default)
    return size


def positive_number(settings: Settings, name: str, default: float) -> float:
    """A positive number. Raises CheckpointError: it is not."""
    value = settings.values.get(name, default)
    if type(value) not in (int, float) or not 0 < value < 2**31:
        raise settings.refusal(name, "a positive number", default)
    return float(value)


def switch(processors: Processors, channel: int, limit: float, below: float, above: float) -> Switch:
    """A number of the actions: ``above`` where it is more than ``limit`` in the robot's units, else ``below``."""
    if processors.action is not None:
        own = processors.action.inverse()
        scale, offset = (float(each[..., channel].flat[0]) for each in (own.scale, own.offset))
        limit, (below, above) = limit * scale + offset, (below, above) if scale > 0 else (above, below)
    limit = float(np.clip(limit, -LARGEST, LARGEST))
    # What is equal to the limit is not more.
    return Switch(channel, float(np.nextafter(np.float32(limit), np.float32(np.inf))), below, above)


class Gathered(nn.Module):
    """What the robot measures to what a prefix reads.

    Args:
        prefix: takes images, tokens, their mask and the state.
        state: numbers of the state, padded or cut; None where the instruction holds it, or nothing reads it.
        task: tokens int64 ``[1, L]`` of the one instruction that is compiled in; None where it is an input.
        committed: whether the network also reads how many actions are committed, and that first.
        normalizer: of the state, which pads it, too; None for the statistics that the processors have.
        frames: of each camera that are images, the oldest of all cameras first.
    """

    task: Tensor | None

    def __init__(
        self,
        config: LeRobotConfig,
        processors: Processors,
        prefix: nn.Module,
        state: int | None,
        task: Tensor | None,
        committed: bool = False,
        normalizer: nn.Module | None = None,
        frames: int = 1,
    ) -> None:
        super().__init__()
        names = {key: processors.renamed.get(key, key).replace(".", "_") for key in config.features}
        self.images, self.state = [names[key] for key in config.cameras], names.get(STATE, "")
        self.normalizer = normalizer or Normalizer(processors.normalizers.get(STATE))
        known = state if state is None or normalizer is not None else config.state_dim
        self.prefix, self.missing = prefix, None if state is None or known is None else state - known
        self.committed, self.frames = committed, frames
        self.register_buffer("task", task, persistent=False)

    def forward(self, observations: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Observations ``[B, 1, ...]`` by argument, the instruction without a frame."""
        newest = range(-self.frames, 0)
        images = [observations[name][:, frame] * 2 - 1 for frame in newest for name in self.images]
        state = None
        if self.missing is not None:
            state = self.normalizer(observations[self.state])[:, -1].to(images[0].dtype)  # statistics may be float64
            state = functional.pad(state, (0, self.missing)) if self.missing >= 0 else state[:, : self.missing]
        if self.task is None:
            tokens, mask = (observations[name.replace(".", "_")] for name in (TOKENS, MASK))
        else:
            tokens = self.task.expand(len(images[0]), -1)
            mask = torch.ones_like(tokens, dtype=torch.bool)
        read: tuple[Tensor, ...] = self.prefix(images, tokens, mask, state)
        return (observations[COMMITTED], *read) if self.committed else read


def seen_size(config: LeRobotConfig, resize: tuple[int, int] | None) -> tuple[int, int]:
    """Height and width of what the image encoder sees: what images are resized to, or the size of all cameras."""
    shapes = {shape[1:] for shape in config.cameras.values()}
    if resize is None and len(shapes) > 1:
        raise config.settings.refusal("resize_imgs_with_padding", "a size: cameras have several")
    height, width = resize or next(iter(shapes))
    return height, width


def require_square(settings: Settings, name: str, image: Sequence[int], multiple: int) -> None:
    """Raise unless images reach the encoder as squares of whole groups of patches."""
    if image[0] != image[1] or image[0] % multiple:
        raise settings.error(
            f"{name}: images reach the encoder as {list(image)}; expected a square of a multiple of {multiple}"
        )


def part_of(model: Settings, name: str) -> Settings:
    """One of the two configurations inside of a language model's, of images or of text."""
    inner = model.values.get(name)
    if not isinstance(inner, dict):
        raise model.refusal(name, "its entries")
    return Settings(inner, f"{model.where}{name}.")


def read_language(text: Settings, layers: int, channels: int) -> LanguageConfig:
    """Sizes of a language model, of which so many layers are used; ``channels`` of a head where it does not say."""
    heads = text.number("num_attention_heads", 32, MOST)
    known = text.values.get("num_key_value_heads", 32) is not None
    config = LanguageConfig(
        width=text.number("hidden_size", 4096, MOST),
        hidden=text.number("intermediate_size", 22016, MOST),
        layers=layers,
        heads=heads,
        groups=text.number("num_key_value_heads", 32) if known else heads,
        channels=text.number("head_dim", channels, MOST),
        epsilon=positive_number(text, "rms_norm_eps", 1e-6),
    )
    if heads % config.groups or config.channels % 2:
        raise text.error(f"{heads} heads of {config.channels} channels do not fit {config.groups} of keys")
    return config


def rope_of(text: Settings, base: float) -> Settings:
    """What a language model says of its rotary embedding; ``base`` where it says nothing of that."""
    found = text.values.get("rope_parameters") or text.values.get("rope_scaling") or {}
    if not isinstance(found, dict):
        raise text.refusal("rope_parameters", "settings by name")
    return Settings({"rope_theta": text.values.get("rope_theta", base), **found}, f"{text.where}rope_parameters.")
