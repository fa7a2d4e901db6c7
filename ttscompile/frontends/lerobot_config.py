"""A LeRobot policy's ``config.json``, read and checked; policies that cannot be compiled are refused by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .multi_task_dit import DiTConfig
from .refusals import LEROBOT, refuse_policy
from .settings import Settings, is_shape, read_json

POLICY = "multi_task_dit"
CONFIG, WEIGHTS = "config.json", "model.safetensors"
STATE = "observation.state"

_CLIP = "openai/clip-vit-base-patch16"
_MOST_CAMERAS, _MOST_PIXELS, _MOST_LETTERS, _MOST_STEPS, _MOST_LAYERS, _MOST = 64, 4096, 200, 4096, 512, 2**16
"""Sizes above these are no policy's. Whether the weights are there for them is asked later, of ``lerobot_weights``."""


@dataclass(frozen=True)
class LeRobotConfig:
    """What of a policy's configuration matters at inference; the names are lerobot's where it has one.

    Attributes:
        features: type (``STATE``, ``VISUAL``, ``ACTION``) and shape by name, inputs and then the action.
        n_obs_steps: To.
        n_action_steps: actions of a chunk that are executed, at most.
        network: of the denoiser.
        flow: whether the objective is flow matching; diffusion otherwise.
        settings: the whole file, for what belongs to one objective.
        vision_encoder_name: CLIP, by name or path.
        text_encoder_name: the same, of the text.
        separate_encoders: whether each camera has an encoder of its own.
        resize: (height, width) of images, or None.
        crop: (height, width) of the centre that is cut out of them, or None.
        tokens: L, of the instruction.
    """

    features: Mapping[str, tuple[str, tuple[int, ...]]]
    n_obs_steps: int
    n_action_steps: int
    network: DiTConfig
    flow: bool
    settings: Settings
    vision_encoder_name: str
    text_encoder_name: str
    separate_encoders: bool
    resize: tuple[int, int] | None
    crop: tuple[int, int] | None
    tokens: int

    @property
    def cameras(self) -> dict[str, tuple[int, ...]]:
        """Shape of each camera's images, in the order of the policy."""
        return {key: shape for key, (kind, shape) in self.features.items() if kind == "VISUAL"}

    @property
    def state_dim(self) -> int:
        """Ds."""
        return self.features[STATE][1][0]


def read_lerobot_config(directory: Path) -> LeRobotConfig:
    """Read and check ``config.json``; defaults are lerobot's.

    Raises:
        CheckpointError: it is missing, of another policy, or contradicts itself.
    """
    path = directory / CONFIG
    entries = read_json(path)
    if (kind := entries.get("type")) != POLICY:
        refuse_policy(f"{kind!s:.80}", LEROBOT, f"{directory}: ")
    settings = Settings(entries, f"{path}: ", "The file was changed, or is of another version of lerobot.")
    features = {**_features(settings, "input_features"), **_features(settings, "output_features")}
    actions = {key: shape for key, (kind, shape) in features.items() if kind == "ACTION"}
    cameras = {key: shape for key, (kind, shape) in features.items() if kind == "VISUAL"}
    if list(actions) != ["action"] or len(actions["action"]) != 1:
        raise settings.error(f"output_features are {features!s:.300}; expected one vector, 'action'")
    if STATE not in features or len(features[STATE][1]) != 1:
        raise settings.error(f"input_features have no vector {STATE!r}, which this policy needs")
    if len(set(cameras.values())) > 1 or any(len(shape) != 3 or shape[0] != 3 for shape in cameras.values()):
        raise settings.error(f"cameras have the shapes {cameras!s:.300}; expected the same [3, height, width] of all")
    if len(cameras) > _MOST_CAMERAS or any(max(shape) > _MOST_PIXELS for shape in cameras.values()):
        raise settings.error(
            f"there are {len(cameras)} cameras of {next(iter(cameras.values()))}; expected {_MOST_CAMERAS} at most, of"
            f" {_MOST_PIXELS} pixels a side at most"
        )
    n_obs_steps, network = settings.number("n_obs_steps", 2, _MOST_STEPS), _network(settings, actions["action"][0])
    if n_obs_steps > network.horizon:
        raise settings.error(f"n_obs_steps is longer than the horizon, {network.horizon}")
    old = settings.flag("use_separate_encoder_per_camera", False)  # the name of lerobot 0.5
    return LeRobotConfig(
        features={key: features[key] for key in (STATE, *cameras, "action")},
        n_obs_steps=n_obs_steps,
        n_action_steps=settings.number("n_action_steps", 24, _MOST),
        network=network,
        flow=settings.choice("objective", "diffusion", "flow_matching") == "flow_matching",
        settings=settings,
        vision_encoder_name=settings.text("vision_encoder_name", _CLIP, _MOST_LETTERS),
        text_encoder_name=settings.text("text_encoder_name", _CLIP, _MOST_LETTERS),
        separate_encoders=settings.flag("use_separate_rgb_encoder_per_camera", old),
        resize=settings.size("image_resize_shape", None, _MOST_PIXELS),
        crop=settings.size("image_crop_shape", [224, 224], _MOST_PIXELS),
        tokens=settings.number("tokenizer_max_length", 77, _MOST),
    )


def _network(settings: Settings, action_dim: int) -> DiTConfig:
    """Sizes and variant of the denoiser."""
    base = settings.values.get("rope_base", 10000.0)
    if type(base) not in (int, float) or not 1 < base < 2**63:
        raise settings.refusal("rope_base", "a number above 1")
    config = DiTConfig(
        action_dim=action_dim,
        horizon=settings.number("horizon", 32, _MOST_STEPS),
        hidden_dim=settings.number("hidden_dim", 512, _MOST),
        num_layers=settings.number("num_layers", 6, _MOST_LAYERS),
        num_heads=settings.number("num_heads", 8, _MOST),
        timestep_embed_dim=settings.number("timestep_embed_dim", 256, _MOST),
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


def _features(settings: Settings, name: str) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Type and shape of each feature."""
    entries = settings.values.get(name)
    if not isinstance(entries, dict):
        raise settings.refusal(name, "type and shape by name")
    found = {}
    for key, entry in entries.items():
        shape: Any = entry.get("shape") if isinstance(entry, dict) else None
        if not is_shape(shape, _MOST):
            expected = f"a type and a shape of sizes up to {_MOST}"
            raise settings.error(f"{name}.{key:.80} is {entry!r:.80}; expected {expected}")
        found[key] = (str(entry.get("type")), tuple(shape))
    return found
