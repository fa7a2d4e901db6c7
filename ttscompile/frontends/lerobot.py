"""LeRobot's ``multi_task_dit``: a directory that lerobot saved to module and ``PolicySpec``.

Everything in the directory is JSON and safetensors; neither lerobot nor torchvision is needed. Normalisers, image
preprocessing and CLIP are part of the module, so that the compiled policy takes what the robot measures.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ..config import ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ..errors import CheckpointError, SpecError
from ..samplers_flow import flow_matching_table
from .clip_config import TextConfig, VisionConfig, encoder_config, find_encoder
from .encoded import EncodedDenoiser
from .image_geometry import ResizeCrop
from .lerobot_config import POLICY, STATE, WEIGHTS, LeRobotConfig, read_lerobot_config
from .lerobot_processors import Normalizer, Processors, read_processors, read_tensors
from .multi_task_dit import ConditionEncoder, DiffusionTransformer, Inputs, ObservationEncoder
from .scheduler import configured_sampler

TOKENS, MASK = "observation.language.tokens", "observation.language.attention_mask"
_SCHEDULERS = {"DDPM": "DDPMScheduler", "DDIM": "DDIMScheduler"}
_SCHEDULER_SETTINGS = {
    "num_train_timesteps": 100,
    "beta_start": 0.0001,
    "beta_end": 0.02,
    "beta_schedule": "squaredcos_cap_v2",
    "clip_sample": True,
    "clip_sample_range": 1.0,
    "prediction_type": "epsilon",
}


def load_lerobot(
    path: str | os.PathLike[str],
    sampler: str | None = None,
    steps: int | None = None,
    spacing: str | None = None,
    task: str | None = None,
    encoders: str | os.PathLike[str] | None = None,
) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory; arguments and errors as ``load_checkpoint_policy``.

    Source: ``MultiTaskDiTPolicy.predict_action_chunk`` of huggingface/lerobot 0.6, and its processors.
    """
    directory = Path(path)
    config = read_lerobot_config(directory)
    processors = read_processors(directory, config.features)
    table = _sampler(config, sampler, steps, spacing)
    folders = [*([Path(encoders)] if encoders is not None else []), directory, directory.resolve().parent]
    text = encoder_config(config.text_encoder_name, "text_config", TextConfig, folders)
    vision = None
    if config.cameras:
        vision = encoder_config(config.vision_encoder_name, "vision_config", VisionConfig, folders)
    if config.tokens > text.max_position_embeddings:
        raise CheckpointError(
            f"{directory}: instructions have {config.tokens} tokens (tokenizer_max_length); the text encoder takes"
            f" {text.max_position_embeddings} at most."
        )
    compiled_in = None if task is None else _tokens(task, config, processors, folders, text)
    try:
        module = build_module(config, processors, vision, text, compiled_in)
        _load_weights(module, read_tensors(directory / WEIGHTS))
    except CheckpointError as error:
        raise CheckpointError(f"{directory}: {error}") from error
    chunk = ChunkSpec(
        action_dim=config.network.action_dim,
        start=config.n_obs_steps - 1,
        stop=min(config.n_obs_steps - 1 + config.n_action_steps, config.network.horizon),
        normalizer=None if processors.action is None else processors.action.inverse(),
        ranged=processors.action is not None and processors.action.mode == "MIN_MAX",
    )
    spec = PolicySpec(
        sample=(config.network.horizon, config.network.action_dim),
        observations=_observations(config, processors, text, compiled_in is None),
        sampler=table,
        chunk=chunk,
        source={
            "format": "lerobot",
            "policy": POLICY,
            "variant": "flow matching" if config.flow else "diffusion",
            "positions": "rotary" if config.network.use_rope else "learned",
            **({"task": task} if task is not None else {}),
        },
    )
    return module.eval(), spec


def _observations(
    config: LeRobotConfig, processors: Processors, text: TextConfig, tokens: bool
) -> dict[str, ObservationSpec]:
    """What the robot gives, under its own names; images as float32 of 0..1, channels first."""
    frames = config.n_obs_steps
    state = processors.normalizers.get(STATE)
    bounds = None if state is None else state.bounds
    specs = {processors.renamed.get(STATE, STATE): ObservationSpec((frames, config.state_dim), bounds=bounds)}
    for key, shape in config.cameras.items():
        specs[processors.renamed.get(key, key)] = ObservationSpec((frames, *shape), bounds=(0.0, 1.0))
    if tokens:
        last = float(text.vocab_size - 1)
        specs[TOKENS] = ObservationSpec((config.tokens,), dtype="int64", window=False, bounds=(0.0, last))
        specs[MASK] = ObservationSpec((config.tokens,), dtype="bool", window=False, bounds=(0.0, 1.0))
    return specs


def build_module(
    config: LeRobotConfig,
    processors: Processors,
    vision: VisionConfig | None,
    text: TextConfig,
    task: tuple[torch.Tensor, torch.Tensor] | None,
) -> EncodedDenoiser:
    """The network without its weights."""
    cameras, network = config.cameras, config.network
    geometry = None
    if vision is not None:
        _, height, width = next(iter(cameras.values()))
        geometry = ResizeCrop(height, width, config.resize, config.crop)
        if geometry.size != (vision.image_size, vision.image_size):
            raise CheckpointError(
                f"images reach the vision encoder as {geometry.size}, and it takes {vision.image_size} pixels square."
                " Check image_resize_shape and image_crop_shape, and that the encoder found is the policy's own."
            )
    encoder = ObservationEncoder(
        len(cameras), vision, text, network.hidden_dim, config.separate_encoders, config.n_obs_steps
    )
    names = [key.replace(".", "_") for key in (processors.renamed.get(k, k) for k in (STATE, *cameras))]
    tokens = (TOKENS.replace(".", "_"), MASK.replace(".", "_")) if task is None else None
    normalizers = [Normalizer(processors.normalizers.get(key)) for key in (STATE, *cameras)]
    condition = ConditionEncoder(encoder, Inputs(names[0], tuple(names[1:]), tokens), geometry, normalizers, task)
    frame = config.state_dim + (vision.hidden_size * len(cameras) if vision is not None else 0) + network.hidden_dim
    return EncodedDenoiser(condition, DiffusionTransformer(network, config.n_obs_steps * frame))


def _sampler(config: LeRobotConfig, sampler: str | None, steps: int | None, spacing: str | None) -> SamplerTable:
    """The denoising loop of the policy's objective."""
    settings = config.settings
    if not config.flow:
        name = settings.get("noise_scheduler_type", "DDPM")
        if name not in _SCHEDULERS:
            raise CheckpointError(f"noise_scheduler_type is {name!r}; expected one of {', '.join(_SCHEDULERS)}.")
        own = {key: settings.get(key, default) for key, default in _SCHEDULER_SETTINGS.items()}
        if own["prediction_type"] not in ("epsilon", "sample"):
            raise CheckpointError(f"prediction_type is {own['prediction_type']!r}; expected epsilon or sample.")
        if steps is None:
            steps = settings.get("num_inference_steps")
        scheduler = {"_target_": _SCHEDULERS[name], **own}
        return configured_sampler(scheduler, steps, step_arguments={}, sampler=sampler, spacing=spacing)
    if spacing is not None:
        raise SpecError("spacing is of the timesteps of diffusion; this policy's objective is flow matching.")
    method: Any = sampler or settings.get("integration_method", "euler")
    count = steps if steps is not None else settings.get("num_integration_steps", 100)
    if type(count) is not int or count < 1:
        raise SpecError(f"{count!r} integration steps are not possible; expected a positive whole number.")
    return flow_matching_table(torch.linspace(0, 1, count + 1).tolist(), method)


def _load_weights(module: EncodedDenoiser, weights: dict[str, torch.Tensor]) -> None:
    """Fill the module; every weight must be there, of the right shape, finite, and nothing else may be there."""
    observer = module.encoder.get_submodule("observation_encoder")
    parts = {"noise_predictor.": module.denoiser, "observation_encoder.": observer}
    expected = {prefix + name: value for prefix, part in parts.items() for name, value in part.state_dict().items()}
    found: dict[str, torch.Tensor] = {}
    for key, value in weights.items():
        # transformers 4 saves an encoder below a level of its own, which transformers 5 leaves out.
        short = key.replace(".model.vision_model.", ".model.").replace(".text_encoder.text_model.", ".text_encoder.")
        if not short.endswith(".position_ids"):
            found[short] = value.float()
    missing, extra = sorted(set(expected) - set(found)), sorted(set(found) - set(expected))
    if missing or extra:
        parts_said = [f"missing {_names(missing)}"] * bool(missing) + [f"unexpected {_names(extra)}"] * bool(extra)
        raise CheckpointError(
            f"the weights do not fit the configuration: {'; '.join(parts_said)}. config.json, or the encoder's, is of"
            " another network than the one that was saved, or the file is incomplete."
        )
    for key, value in found.items():
        if value.shape != expected[key].shape:
            raise CheckpointError(
                f"weight {key} has shape {tuple(value.shape)}; expected {tuple(expected[key].shape)} from config.json"
                " and the encoder's configuration."
            )
        if not torch.isfinite(value).all():
            count = int((~torch.isfinite(value)).sum())
            raise CheckpointError(f"weight {key} holds {count} values that are not finite; training diverged.")
    for prefix, part in parts.items():
        part.load_state_dict(
            {key.removeprefix(prefix): value for key, value in found.items() if key.startswith(prefix)}
        )


def _names(keys: list[str]) -> str:
    """A few names and how many more there are."""
    more = f" and {len(keys) - 4} more" if len(keys) > 4 else ""
    return ", ".join(keys[:4]) + more


def _tokens(
    task: str, config: LeRobotConfig, processors: Processors, folders: list[Path], text: TextConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tokens and mask ``[1, L]`` of an instruction, as lerobot's processor makes them."""
    settings = processors.tokenizer or {}
    name = settings.get("tokenizer_name") or config.text_encoder_name
    found = find_encoder(str(name), folders)
    if found is None or not any((found / file).is_file() for file in ("tokenizer.json", "vocab.json")):
        raise CheckpointError(
            f"the tokenizer {name!r} is not on this machine, and nothing is ever downloaded; it is needed to compile"
            " the policy for one task. Put config.json and the tokenizer's files (tokenizer.json, or vocab.json and"
            " merges.txt) of the text encoder into one folder, and name it: encoders= in Python, --encoders on the"
            " command line. Or leave the task out: the policy then takes tokens as an observation."
        )
    try:
        from transformers import CLIPTokenizer
    except ModuleNotFoundError as error:
        raise CheckpointError(
            "compiling a policy for one task needs the tokenizer of transformers, which is not installed. Install"
            " 'ttscompile[lerobot]', or leave the task out: the policy then takes tokens as an observation."
        ) from error
    try:
        tokenizer = CLIPTokenizer.from_pretrained(str(found), local_files_only=True)
        tokenizer.padding_side = settings.get("padding_side", "right")
        made = tokenizer(
            [task],
            max_length=config.tokens,
            padding=settings.get("padding", "max_length"),
            truncation=settings.get("truncation", True),
            return_tensors="pt",
        )
        tokens, mask = made["input_ids"].to(torch.int64), made["attention_mask"].to(torch.bool)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{found}: the tokenizer cannot be read, or refuses {task!r}: {error}") from error
    if int(tokens.max()) >= text.vocab_size:
        raise CheckpointError(
            f"{found}: its tokenizer gives token {int(tokens.max())}; the encoder has"
            f" {text.vocab_size}. It belongs to another text encoder."
        )
    return tokens, mask
