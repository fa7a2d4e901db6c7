"""LeRobot's ``multi_task_dit``: its directory to module and ``PolicySpec``.

Normalisers, image preprocessing and CLIP are part of the module, so that the compiled policy takes what the robot
measures. Neither lerobot nor torchvision is needed.

Source: ``MultiTaskDiTPolicy.predict_action_chunk`` of huggingface/lerobot 0.6, and its processors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ttscompile.core.spec import Instruction, PolicySpec, SamplerTable
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.loops import Loops, loops_of
from ttscompile.frontends.saved_weights import require_weights
from ttscompile.frontends.settings import Settings
from ttscompile.samplers.flow import METHODS, flow_matching_table

from ..instruction import NO_TASK, encoder_folders, find_encoder, task_tokens
from ..networks.clip import TextConfig, VisionConfig, encoder_config
from ..networks.image_geometry import ResizeCrop
from ..networks.multi_task_dit import DiffusionTransformer, DiTConfig, ObservationEncoder
from . import policy as lerobot
from .config import CONFIG, MOST, MOST_PIXELS, STATE, LeRobotConfig, read_lerobot_config
from .processors import PREPROCESSOR, Processors, read_processors

_CLIP = "openai/clip-vit-base-patch16"
_MOST_LETTERS, _MOST_LAYERS = 200, 512
"""Of a name; of all transformers together, each of which is made twice, first without memory, which takes time."""


@dataclass(frozen=True)
class MultiTaskDiTConfig(LeRobotConfig):
    """What this type has beside what all have.

    Attributes:
        flow: whether the objective is flow matching; diffusion otherwise.
        vision_encoder_name: CLIP, by name or path.
        text_encoder_name: the same, of the text.
        separate_encoders: whether each camera has an encoder of its own.
        resize: (height, width) of images, or None.
        crop: (height, width) of the centre that is cut out of them, or None.
        tokens: L, of the instruction.
    """

    network: DiTConfig
    flow: bool
    vision_encoder_name: str
    text_encoder_name: str
    separate_encoders: bool
    resize: tuple[int, int] | None
    crop: tuple[int, int] | None
    tokens: int


def read_config(directory: Path, entries: Mapping[str, Any]) -> MultiTaskDiTConfig:
    """Check ``config.json``, of which these are the entries; defaults are lerobot's."""
    shared = read_lerobot_config(directory, entries, horizon=32, n_action_steps=24, environment=False)
    settings = shared.settings
    old = settings.flag("use_separate_encoder_per_camera", False)  # the name of lerobot 0.5
    return MultiTaskDiTConfig(
        **vars(shared),
        network=_network(settings, shared),
        flow=settings.choice("objective", "diffusion", "flow_matching") == "flow_matching",
        vision_encoder_name=settings.text("vision_encoder_name", _CLIP, _MOST_LETTERS),
        text_encoder_name=settings.text("text_encoder_name", _CLIP, _MOST_LETTERS),
        separate_encoders=settings.flag("use_separate_rgb_encoder_per_camera", old),
        resize=settings.size("image_resize_shape", None, MOST_PIXELS),
        crop=settings.size("image_crop_shape", [224, 224], MOST_PIXELS),
        tokens=settings.number("tokenizer_max_length", 77, MOST),
    )


def _network(settings: Settings, shared: LeRobotConfig) -> DiTConfig:
    base = settings.values.get("rope_base", 10000.0)
    if type(base) not in (int, float) or not 1 < base < 2**63:
        raise settings.refusal("rope_base", "a number above 1")
    config = DiTConfig(
        action_dim=shared.action_dim,
        horizon=shared.horizon,
        hidden_dim=settings.number("hidden_dim", 512, MOST),
        num_layers=settings.number("num_layers", 6, _MOST_LAYERS),
        num_heads=settings.number("num_heads", 8, MOST),
        timestep_embed_dim=settings.number("timestep_embed_dim", 256, MOST),
        use_positional_encoding=settings.flag("use_positional_encoding", False),
        use_rope=settings.flag("use_rope", True),
        rope_base=float(base),
    )
    width, heads = config.hidden_dim, config.num_heads
    if width % heads or (config.use_rope and width // heads % 2):
        raise settings.error(f"hidden_dim is {width} with {heads} heads; expected an even width for each head")
    if config.timestep_embed_dim % 2 or config.timestep_embed_dim < 4:
        raise settings.refusal("timestep_embed_dim", "an even number from 4 on")
    return config


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    config = read_config(directory, entries)
    if options.without_cameras is not None:
        raise CheckpointError(f"{directory}: multi_task_dit needs all its cameras. Leave out without_cameras.")
    processors = read_processors(directory, config.features)
    folders = encoder_folders(options.encoders, directory)
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
    if (side := processors.tokenizer.get("padding_side", "right")) != "right":
        raise CheckpointError(
            f"{directory}/{PREPROCESSOR}: the tokenizer's padding_side is {side!r:.80}; expected right. CLIP pads with"
            " its end token, and the network reads the first of these: what lerobot reads there has seen no word, and"
            " is another number in other versions. Train with tokenizer_padding_side right."
        )
    compiled_in = None if options.task is None else _tokens(options.task, config, processors, folders, text)
    weights = _read_weights(config, options)
    try:
        # Compared before anything of the configured sizes is made, so that no more memory is taken than the file has.
        _require_network(config, vision, text, weights)
        network = Network(config, vision, text)
        network.load_state_dict(weights)
        module = with_inputs(network, config, processors, vision, compiled_in)
    except CheckpointError as error:
        raise CheckpointError(f"{directory}: {error}") from error
    source = {
        "policy": "multi_task_dit",
        "variant": "flow matching" if config.flow else "diffusion",
        "positions": "rotary" if config.network.use_rope else "learned",
        **({} if options.task is None else {"task": options.task}),
    }
    language = lerobot.language_inputs(config.tokens, text.vocab_size) if compiled_in is None else {}
    spec = lerobot.policy_spec(config, processors, _loops(config, options), source, language)
    if language and _in_words(processors):
        spec = replace(spec, instruction=Instruction(lerobot.TOKENS, lerobot.MASK, processors.new_line))
    return module.eval(), spec


def with_inputs(
    network: Network,
    config: MultiTaskDiTConfig,
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
    condition = ConditionEncoder(config, processors, geometry, network.observation_encoder, task)
    return EncodedDenoiser(condition, network.noise_predictor)


def _loops(config: MultiTaskDiTConfig, options: LoadOptions) -> Loops:
    if not config.flow:
        return lerobot.diffusion_loops(config, options)
    return loops_of(lambda each: _flow(config, each), options, "its own integration")


def _flow(config: MultiTaskDiTConfig, options: LoadOptions) -> SamplerTable:
    """The integration that is configured, or asked for in its place."""
    method = options.sampler or config.settings.choice("integration_method", *METHODS)
    count = lerobot.integration_steps(config.settings, options, "num_integration_steps", 100)
    return flow_matching_table(torch.linspace(0, 1, count + 1).tolist(), method)


def _tokens(
    task: str, config: MultiTaskDiTConfig, processors: Processors, folders: list[Path], text: TextConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tokens and mask ``[1, n]`` of an instruction, without lerobot's padding: no token before it reads that."""
    if not _in_words(processors):
        raise CheckpointError(
            f"{PREPROCESSOR}: the tokenizer does not cut the instruction; expected truncation true. {NO_TASK}"
        )
    name = str(processors.tokenizer.get("tokenizer_name") or config.text_encoder_name)
    tokens = torch.tensor([task_tokens(task, name, find_encoder(name, folders), config.tokens, text.vocab_size)])
    return tokens, torch.ones_like(tokens, dtype=torch.bool)


def _in_words(processors: Processors) -> bool:
    """Whether the instruction's tokens are cut at the last place, as text becomes them here."""
    return processors.tokenizer.get("truncation", True) is True


def _read_weights(config: MultiTaskDiTConfig, options: LoadOptions) -> dict[str, torch.Tensor]:
    """The weights of a policy as float32, under the names that transformers 5 gives."""
    found = {}
    for name, value in lerobot.read_weights(config, options, ".position_ids").items():
        # transformers 4 saves an encoder below a level of its own, which transformers 5 leaves out.
        short = name.replace(".model.vision_model.", ".model.")
        found[short.replace(".text_encoder.text_model.", ".text_encoder.")] = value
    return found


class Network(nn.Module):
    """Denoiser and observation encoder, under the names of their weights; ``vision`` is None without cameras."""

    def __init__(self, config: MultiTaskDiTConfig, vision: VisionConfig | None, text: TextConfig) -> None:
        super().__init__()
        cameras, width, frames = len(config.cameras), config.network.hidden_dim, config.n_obs_steps
        frame = config.state_dim + (0 if vision is None else vision.hidden_size * cameras) + width
        self.noise_predictor = DiffusionTransformer(config.network, frames * frame)
        self.observation_encoder = ObservationEncoder(cameras, vision, text, width, config.separate_encoders, frames)


class ConditionEncoder(lerobot.Measured):
    """Raw observations to the condition vector: normalised, cropped and encoded.

    Args:
        task: tokens int64 ``[1, L]`` and mask bool ``[1, L]`` of the one instruction that is compiled in; None where it
            is an input.
    """

    task_tokens: torch.Tensor
    task_mask: torch.Tensor

    def __init__(
        self,
        config: LeRobotConfig,
        processors: Processors,
        geometry: ResizeCrop | None,
        observation_encoder: ObservationEncoder,
        task: tuple[torch.Tensor, torch.Tensor] | None = None,
    ) -> None:
        super().__init__(config, processors, geometry)
        self.observation_encoder, self.has_task = observation_encoder, task is not None
        if task is not None:
            self.register_buffer("task_tokens", task[0], persistent=False)
            self.register_buffer("task_mask", task[1], persistent=False)

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Observations ``[B, ...]`` by name -> ``[B, C]``."""
        measured = self.measured(observations)
        images = [measured[key] for key in self.cameras]
        tokens, mask = (observations.get(name.replace(".", "_")) for name in (lerobot.TOKENS, lerobot.MASK))
        if self.has_task:
            tokens, mask = self.task_tokens, self.task_mask
        return self.observation_encoder(measured[STATE], images, tokens, mask)  # type: ignore[no-any-return]


def _require_network(
    config: MultiTaskDiTConfig, vision: VisionConfig | None, text: TextConfig, weights: Mapping[str, torch.Tensor]
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
