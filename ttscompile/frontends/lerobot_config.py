"""A LeRobot policy's ``config.json``, read and checked; policies that cannot be compiled are refused by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import CheckpointError
from .json_files import read_json
from .multi_task_dit import DiTConfig

POLICY = "multi_task_dit"
CONFIG, WEIGHTS, ADAPTER = "config.json", "model.safetensors", "adapter_config.json"
STATE = "observation.state"

_MOST_CAMERAS, _MOST_PIXELS, _MOST_LETTERS = 64, 4096, 200
_MOST = {"horizon": 4096, "n_obs_steps": 4096, "num_layers": 512}
_MOST_OTHERWISE = 2**16
"""Sizes above these are no policy's. Whether the weights are there for them is asked later, of ``lerobot_weights``."""

_BY_HAND = (
    "Its action head can be compiled from its own code: ttscompile.compile_denoiser(module, spec), with the features"
    " that the head reads as observations (examples/vla shows how)."
)
_REFUSED: Mapping[str, str] = {
    "diffusion": "a U-Net: its denoiser is no transformer and has no residual stream whose blocks could be reused."
    " Train multi_task_dit on the same data.",
    "act": "a transformer that predicts actions in one evaluation: there is no denoising loop to make sparse.",
    "vqbet": "autoregressive over discrete codes: there is no denoising loop to make sparse.",
    "tdmpc": "a world model with a planner: there is no denoising loop to make sparse.",
    "sac": "a reinforcement-learning actor: there is no denoising loop to make sparse.",
    "pi0_fast": "autoregressive over action tokens: there is no denoising loop to make sparse.",
    "smolvla": f"a vision-language model with a flow-matching action expert. {_BY_HAND}",
    "pi0": f"a vision-language model with a flow-matching action expert. {_BY_HAND}",
    "pi05": f"a vision-language model with a flow-matching action expert. {_BY_HAND}",
    "groot": f"a vision-language model with a flow-matching DiT. {_BY_HAND}",
    "xvla": f"a vision-language model with a flow-matching action head. {_BY_HAND}",
    "wall_x": f"a vision-language model with a mixture of experts. {_BY_HAND}",
}


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
    settings: Mapping[str, Any]
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


def is_lerobot(directory: Path) -> bool:
    """Whether a directory is what lerobot saves: a configuration with a type, or an adapter."""
    if (directory / ADAPTER).is_file():
        return True
    return (directory / CONFIG).is_file() and "type" in read_json(directory / CONFIG)


def read_lerobot_config(directory: Path) -> LeRobotConfig:
    """Read and check ``config.json``.

    Raises:
        CheckpointError: it is missing, of another policy, or contradicts itself.
    """
    if not (directory / WEIGHTS).is_file() and (directory / ADAPTER).is_file():
        raise CheckpointError(
            f"{directory}: holds a PEFT adapter ({ADAPTER}) and no weights of the policy itself ({WEIGHTS}). Merge the"
            " adapter into its base policy (peft: model.merge_and_unload()), save that with save_pretrained, and"
            " convert the result."
        )
    settings = read_json(directory / CONFIG)
    kind = settings.get("type")
    if kind != POLICY:
        unknown = (
            "not known. If its denoiser is a transformer, build it and use ttscompile.compile_denoiser(module, spec)."
        )
        why = _REFUSED.get(kind, unknown) if isinstance(kind, str) else unknown
        raise CheckpointError(f"{directory}: the policy is {kind!r:.80}, {why} Expected a directory of {POLICY!r}.")
    return _Reader(directory / CONFIG, settings).read()


class _Reader:
    """Entries of one file, each checked as it is taken; defaults are lerobot's."""

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        self.path, self.settings = path, settings

    def read(self) -> LeRobotConfig:
        features = {**self.features("input_features"), **self.features("output_features")}
        actions = [(key, shape) for key, (kind, shape) in features.items() if kind == "ACTION"]
        if [key for key, _ in actions] != ["action"] or len(actions[0][1]) != 1:
            raise self.error(f"output_features are {features!s:.300}; expected one vector, 'action'")
        if STATE not in features or len(features[STATE][1]) != 1:
            raise self.error(f"input_features have no vector {STATE!r}, which this policy needs")
        cameras = {key: shape for key, (kind, shape) in features.items() if kind == "VISUAL"}
        if len(set(cameras.values())) > 1 or any(len(shape) != 3 or shape[0] != 3 for shape in cameras.values()):
            raise self.error(f"cameras have the shapes {cameras!s:.300}; expected the same [3, height, width] of all")
        if len(cameras) > _MOST_CAMERAS or any(max(shape) > _MOST_PIXELS for shape in cameras.values()):
            raise self.error(
                f"there are {len(cameras)} cameras of {next(iter(cameras.values()))}; expected {_MOST_CAMERAS} at most,"
                f" of {_MOST_PIXELS} pixels a side at most"
            )
        objective = self.settings.get("objective", "diffusion")
        if objective not in ("diffusion", "flow_matching"):
            raise self.error(f"objective is {objective!r:.80}; expected diffusion or flow_matching")
        old = self.flag("use_separate_encoder_per_camera", False)  # the name of lerobot 0.5
        return LeRobotConfig(
            features={key: features[key] for key in (STATE, *cameras, "action")},
            n_obs_steps=self.number("n_obs_steps", 2),
            n_action_steps=self.number("n_action_steps", 24),
            network=self.network(actions[0][1][0]),
            flow=objective == "flow_matching",
            settings=self.settings,
            vision_encoder_name=self.text("vision_encoder_name", "openai/clip-vit-base-patch16"),
            text_encoder_name=self.text("text_encoder_name", "openai/clip-vit-base-patch16"),
            separate_encoders=self.flag("use_separate_rgb_encoder_per_camera", old),
            resize=self.size("image_resize_shape", None),
            crop=self.size("image_crop_shape", [224, 224]),
            tokens=self.number("tokenizer_max_length", 77),
        )

    def network(self, action_dim: int) -> DiTConfig:
        base = self.settings.get("rope_base", 10000.0)
        if type(base) not in (int, float) or not 1 < base < 2**63:
            raise self.error(f"rope_base is {base!r:.80}; expected a number above 1")
        config = DiTConfig(
            action_dim=action_dim,
            horizon=self.number("horizon", 32),
            hidden_dim=self.number("hidden_dim", 512),
            num_layers=self.number("num_layers", 6),
            num_heads=self.number("num_heads", 8),
            timestep_embed_dim=self.number("timestep_embed_dim", 256),
            use_positional_encoding=self.flag("use_positional_encoding", False),
            use_rope=self.flag("use_rope", True),
            rope_base=float(base),
        )
        width, heads = config.hidden_dim, config.num_heads
        if width % heads or (config.use_rope and width // heads % 2):
            raise self.error(f"hidden_dim is {width} with {heads} heads; expected an even width for each head")
        if config.timestep_embed_dim % 2 or config.timestep_embed_dim < 4:
            raise self.error(f"timestep_embed_dim is {config.timestep_embed_dim}; expected an even number from 4 on")
        if self.number("n_obs_steps", 2) > config.horizon:
            raise self.error(f"n_obs_steps is longer than the horizon, {config.horizon}")
        return config

    def features(self, name: str) -> dict[str, tuple[str, tuple[int, ...]]]:
        entries = self.settings.get(name)
        if not isinstance(entries, dict):
            raise self.error(f"{name} is {entries!r:.80}; expected type and shape by name")
        found = {}
        for key, entry in entries.items():
            shape = entry.get("shape") if isinstance(entry, dict) else None
            if not isinstance(shape, list) or not shape or not all(map(_is_size, shape)):
                raise self.error(
                    f"{name}.{key:.80} is {entry!r:.80}; expected a type and a shape of sizes up to {_MOST_OTHERWISE}"
                )
            found[key] = (str(entry.get("type")), tuple(shape))
        return found

    def number(self, name: str, default: int) -> int:
        value = self.settings.get(name, default)
        most = _MOST.get(name, _MOST_OTHERWISE)
        if type(value) is not int or not 1 <= value <= most:
            raise self.error(f"{name} is {value!r:.80}; expected a positive whole number, {most} at most")
        return value

    def flag(self, name: str, default: bool) -> bool:
        value = self.settings.get(name, default)
        if type(value) is not bool:
            raise self.error(f"{name} is {value!r:.80}; expected true or false")
        return value

    def text(self, name: str, default: str) -> str:
        value = self.settings.get(name, default)
        if not isinstance(value, str) or not 0 < len(value) <= _MOST_LETTERS:
            raise self.error(f"{name} is {value!r:.80}; expected a name")
        return value

    def size(self, name: str, default: list[int] | None) -> tuple[int, int] | None:
        value = self.settings.get(name, default)
        if value is None:
            return None
        if not isinstance(value, list) or len(value) != 2 or not all(_is_size(n, _MOST_PIXELS) for n in value):
            raise self.error(
                f"{name} is {value!r:.80}; expected [height, width] of {_MOST_PIXELS} pixels at most, or null"
            )
        return value[0], value[1]

    def error(self, what: str) -> CheckpointError:
        return CheckpointError(f"{self.path}: {what}. The file was changed, or is of another version of lerobot.")


def _is_size(value: Any, most: int = _MOST_OTHERWISE) -> bool:
    return type(value) is int and 1 <= value <= most
