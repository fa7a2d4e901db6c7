"""LeRobot's ``multi_task_dit``: a directory that lerobot saved to module and ``PolicySpec``.

Everything in the directory is JSON and safetensors; neither lerobot nor torchvision is needed. Normalisers, image
preprocessing and CLIP are part of the module, so that the compiled policy takes what the robot measures.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ..core.spec import ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ..errors import CheckpointError, SpecError
from ..samplers.flow import METHODS, flow_matching_table
from .clip import NAME_FOLDER, TextConfig, VisionConfig, encoder_config, find_encoder
from .encoded import EncodedDenoiser
from .families import LoadOptions
from .image_geometry import ResizeCrop
from .lerobot_config import CONFIG, POLICY, STATE, WEIGHTS, LeRobotConfig, read_lerobot_config
from .lerobot_processors import PREPROCESSOR, Normalizer, Processors, read_processors
from .multi_task_dit import ConditionEncoder, DiffusionTransformer, ObservationEncoder
from .saved_weights import as_float32, read_tensors, require_weights
from .scheduler import MOST_STEPS, configured_sampler

_MOST_TOKENIZER_BYTES = 16 * 2**20
"""Of one file; CLIP's own tokenizer.json has 2 MB."""

_MOST_LAYERS = 512
"""Of all transformers together. Each is made twice, first without memory, which takes time."""

_NO_TASK = "Or leave the task out: the policy then takes tokens as an observation."
TOKENS, MASK = "observation.language.tokens", "observation.language.attention_mask"
_SCHEDULER_SETTINGS = {
    "num_train_timesteps": 100,
    "beta_start": 0.0001,
    "beta_end": 0.02,
    "beta_schedule": "squaredcos_cap_v2",
    "clip_sample": True,
    "clip_sample_range": 1.0,
}


def load(directory: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory; see ``Family.load``.

    Source: ``MultiTaskDiTPolicy.predict_action_chunk`` of huggingface/lerobot 0.6, and its processors.
    """
    config = read_lerobot_config(directory)
    processors = read_processors(directory, config.features)
    folders = [*([] if options.encoders is None else [Path(options.encoders)]), directory, directory.resolve().parent]
    text = encoder_config(config.text_encoder_name, "text_config", TextConfig, folders)
    seen = bool(config.cameras)
    vision = encoder_config(config.vision_encoder_name, "vision_config", VisionConfig, folders) if seen else None
    if config.tokens > text.max_position_embeddings:
        raise CheckpointError(
            f"{directory}: tokenizer_max_length is {config.tokens}; the text encoder takes"
            f" {text.max_position_embeddings} at most."
        )
    length = processors.tokenizer.get("max_length", config.tokens)
    if length != config.tokens:
        raise CheckpointError(
            f"{directory}: the tokenizer's max_length is {length!r:.80}, and tokenizer_max_length of {CONFIG} is"
            f" {config.tokens}; expected the same number."
        )
    compiled_in = None if options.task is None else _tokens(options.task, config, processors, folders, text)
    weights = _read_weights(directory / WEIGHTS)
    try:
        # Compared before anything of the configured sizes is made, so that no more memory is taken than the file has.
        _require_network(config, vision, text, weights)
        network = Network(config, vision, text)
        network.load_state_dict(weights)
        module = with_inputs(network, config, processors, vision, compiled_in)
    except CheckpointError as error:
        raise CheckpointError(f"{directory}: {error}") from error
    horizon, action_dim, start = config.network.horizon, config.network.action_dim, config.n_obs_steps - 1
    spec = PolicySpec(
        sample=(horizon, action_dim),
        observations=_observations(config, processors, text, compiled_in is None),
        sampler=_sampler(config, str(directory / CONFIG), options),
        chunk=ChunkSpec(
            action_dim=action_dim,
            start=start,
            stop=min(start + config.n_action_steps, horizon),
            normalizer=None if processors.action is None else processors.action.inverse(),
            ranged=processors.action is not None and processors.action.mode == "MIN_MAX",
        ),
        source={
            "format": "lerobot",
            "policy": POLICY,
            "variant": "flow matching" if config.flow else "diffusion",
            "positions": "rotary" if config.network.use_rope else "learned",
            **({} if options.task is None else {"task": options.task}),
        },
    )
    return module.eval(), spec


def _observations(
    config: LeRobotConfig, processors: Processors, text: TextConfig, tokens: bool
) -> dict[str, ObservationSpec]:
    """What the robot gives, under its own names; images as float32 of 0..1, channels first."""
    frames = config.n_obs_steps
    state = processors.normalizers.get(STATE)
    usual = None if state is None else state.usual_range
    specs = {processors.renamed.get(STATE, STATE): ObservationSpec((frames, config.state_dim), bounds=usual)}
    for key, shape in config.cameras.items():
        specs[processors.renamed.get(key, key)] = ObservationSpec((frames, *shape), bounds=(0.0, 1.0))
    if tokens:
        last = float(text.vocab_size - 1)
        specs[TOKENS] = ObservationSpec((config.tokens,), dtype="int64", window=False, bounds=(0.0, last))
        specs[MASK] = ObservationSpec((config.tokens,), dtype="bool", window=False, bounds=(0.0, 1.0))
    return specs


def with_inputs(
    network: Network,
    config: LeRobotConfig,
    processors: Processors,
    vision: VisionConfig | None,
    task: tuple[torch.Tensor, torch.Tensor] | None,
) -> EncodedDenoiser:
    """The network behind what lerobot does to observations: it takes what the robot measures."""
    geometry = None
    if vision is not None:
        _, height, width = next(iter(config.cameras.values()))
        geometry = ResizeCrop(height, width, config.resize, config.crop)
        if geometry.size != (vision.image_size, vision.image_size):
            raise CheckpointError(
                f"images reach the vision encoder as {geometry.size}, and it takes {vision.image_size} pixels square."
                " Check image_resize_shape and image_crop_shape, and that the encoder found is the policy's own."
            )
    names = [processors.renamed.get(key, key).replace(".", "_") for key in (STATE, *config.cameras)]
    tokens = TOKENS.replace(".", "_"), MASK.replace(".", "_")
    normalizers = [Normalizer(processors.normalizers.get(key)) for key in (STATE, *config.cameras)]
    condition = ConditionEncoder(network.observation_encoder, names, tokens, geometry, normalizers, task)
    return EncodedDenoiser(condition, network.noise_predictor)


def _sampler(config: LeRobotConfig, where: str, options: LoadOptions) -> SamplerTable:
    """The denoising loop of the policy's objective; ``where`` is the configuration, for messages."""
    settings = config.settings.values
    if not config.flow:
        scheduler = {key: settings.get(key, default) for key, default in _SCHEDULER_SETTINGS.items()}
        scheduler["_target_"] = f"{config.settings.choice('noise_scheduler_type', 'DDPM', 'DDIM')}Scheduler"
        scheduler["prediction_type"] = config.settings.choice("prediction_type", "epsilon", "sample")
        return configured_sampler(scheduler, settings.get("num_inference_steps"), options, where=where)
    if options.spacing is not None:
        raise SpecError("spacing is of the timesteps of diffusion; this policy's objective is flow matching.")
    method: Any = options.sampler or config.settings.choice("integration_method", *METHODS)
    count = options.steps if options.steps is not None else settings.get("num_integration_steps", 100)
    if type(count) is not int or not 1 <= count <= MOST_STEPS:
        given = "num_integration_steps, or steps= and --steps"
        raise SpecError(f"{where}: {count!r:.80} integration steps ({given}); expected 1 to {MOST_STEPS}.")
    return flow_matching_table(torch.linspace(0, 1, count + 1).tolist(), method)


def _tokens(
    task: str, config: LeRobotConfig, processors: Processors, folders: list[Path], text: TextConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tokens and mask ``[1, L]`` of an instruction, as lerobot's processor makes them."""
    settings = processors.tokenizer
    name = str(settings.get("tokenizer_name") or config.text_encoder_name)
    found = find_encoder(name, folders)
    if found is None or not any((found / file).is_file() for file in ("tokenizer.json", "vocab.json")):
        raise CheckpointError(
            f"the tokenizer {name!r:.200} is not on this machine, and nothing is ever downloaded. Put config.json and"
            f" tokenizer.json (or vocab.json and merges.txt) of the text encoder into one folder. {NAME_FOLDER}"
            f" {_NO_TASK}"
        )
    files = [file for file in sorted(found.iterdir()) if file.suffix in (".json", ".txt")]
    large = [file.name for file in files if file.stat().st_size > _MOST_TOKENIZER_BYTES]
    if large:
        raise CheckpointError(
            f"{found}: {', '.join(large[:4])} of the tokenizer has more than {_MOST_TOKENIZER_BYTES:,} bytes; CLIP's"
            " own has less than 3 MB. It is of another model, or damaged."
        )
    try:
        from transformers import CLIPTokenizer
    except ModuleNotFoundError as error:
        raise CheckpointError(
            "compiling a policy for one task needs the tokenizer of transformers, which is not installed. Install"
            f" 'ttscompile[lerobot]'. {_NO_TASK}"
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
    except Exception as error:  # of damaged files the tokenizers package raises plain Exception
        raise CheckpointError(
            f"{found}: the tokenizer cannot be read, or refuses {task!r:.200}: {type(error).__name__}:"
            f" {error!s:.300}. Copy its files again."
        ) from error
    if tokens.shape != mask.shape or tokens.shape[0] != 1 or not 1 <= tokens.shape[-1] <= config.tokens:
        raise CheckpointError(
            f"{found}: its tokenizer gives tokens {list(tokens.shape)} and a mask {list(mask.shape)}; expected [1, L]"
            f" of both, and L = {config.tokens} at most. Shorten the task, or check truncation of {PREPROCESSOR}."
        )
    if int(tokens.max()) >= text.vocab_size:
        most = f"token {int(tokens.max())}; the encoder has {text.vocab_size}"
        raise CheckpointError(f"{found}: its tokenizer gives {most}. It belongs to another text encoder.")
    return tokens, mask


def _read_weights(path: Path) -> dict[str, torch.Tensor]:
    """The weights of a policy as float32, under the names that transformers 5 gives."""
    saved = {name: value for name, value in read_tensors(path).items() if not name.endswith(".position_ids")}
    found = {}
    for name, value in as_float32(saved, f"{path}: ").items():
        # transformers 4 saves an encoder below a level of its own, which transformers 5 leaves out.
        short = name.replace(".model.vision_model.", ".model.")
        found[short.replace(".text_encoder.text_model.", ".text_encoder.")] = value
    return found


class Network(nn.Module):
    """Denoiser and observation encoder, under the names of their weights; ``vision`` is None without cameras."""

    def __init__(self, config: LeRobotConfig, vision: VisionConfig | None, text: TextConfig) -> None:
        super().__init__()
        cameras, width, frames = len(config.cameras), config.network.hidden_dim, config.n_obs_steps
        frame = config.state_dim + (0 if vision is None else vision.hidden_size * cameras) + width
        self.noise_predictor = DiffusionTransformer(config.network, frames * frame)
        self.observation_encoder = ObservationEncoder(cameras, vision, text, width, config.separate_encoders, frames)


def _require_network(
    config: LeRobotConfig, vision: VisionConfig | None, text: TextConfig, weights: Mapping[str, torch.Tensor]
) -> None:
    """Raise unless the weights are those of the network that is configured.

    The network is made on the meta device: shapes, and no memory, whatever the configuration asks for.
    """
    eyes = 0 if vision is None else vision.num_hidden_layers * (len(config.cameras) if config.separate_encoders else 1)
    layers = config.network.num_layers + text.num_hidden_layers + eyes
    if layers > _MOST_LAYERS:
        raise CheckpointError(
            f"the configuration asks for {layers} layers, {eyes} of them of image encoders; expected {_MOST_LAYERS} at"
            " most. config.json, or the encoder's, is of another network."
        )
    with torch.device("meta"):
        expected = Network(config, vision, text).state_dict()
    require_weights(expected, weights, "config.json, or the encoder's,")
