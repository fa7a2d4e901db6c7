"""A LeRobot policy's ``config.json``: what all types of policies have in it, read and checked."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ttscompile.frontends.settings import Settings, is_shape

from .processors import STATE as STATE, Features

CONFIG, WEIGHTS = "config.json", "model.safetensors"
ENVIRONMENT, ACTION = "observation.environment_state", "action"

MOST_PIXELS, MOST_STEPS, MOST = 4096, 4096, 2**16
MOST_LAYERS, MOST_VOCABULARY, MOST_LETTERS, MOST_CAMERAS = 512, 2**20, 400, 64
"""Sizes above these are no policy's. Whether the weights are there for them is asked later."""


@dataclass(frozen=True)
class LeRobotConfig:
    """What of a policy's configuration matters at inference, whatever its type; the names are lerobot's.

    Attributes:
        settings: the whole file, for what belongs to one type.
        features: type (``STATE``, ``VISUAL``, ``ENV``, ``ACTION``) and shape by name: state, cameras, environment if
            it has one, and then the action.
        n_obs_steps: To.
        horizon: T.
        n_action_steps: actions of a chunk that are executed, at most.
    """

    directory: Path
    settings: Settings
    features: Features
    n_obs_steps: int
    horizon: int
    n_action_steps: int

    @property
    def cameras(self) -> dict[str, tuple[int, ...]]:
        """Shape of each camera's images, in the order of the policy."""
        return {key: shape for key, (kind, shape) in self.features.items() if kind == "VISUAL"}

    @property
    def state_dim(self) -> int:
        """Ds."""
        return self.features[STATE][1][0]

    @property
    def action_dim(self) -> int:
        """Da."""
        return self.features[ACTION][1][0]


def read_lerobot_config(
    directory: Path,
    entries: Mapping[str, Any],
    *,
    horizon: int,
    n_action_steps: int,
    environment: bool = False,
    chunked: bool = False,
    stateless: bool = False,
) -> LeRobotConfig:
    """Check what all types have.

    Args:
        environment: whether this type reads the state of the environment; if not, it is no observation.
        chunked: whether the horizon is called ``chunk_size``, one frame is observed, and every camera has a shape of
            its own: vision-language-action models and ``act``.
        stateless: whether this type can do without the robot's state.
    """
    remedy = "If lerobot takes the file, this is not compiled; else it was changed, or is of another of its versions."
    settings = Settings(entries, f"{directory / CONFIG}: ", remedy)
    features = {**_features(settings, "input_features"), **_features(settings, "output_features")}
    # A data set may have more of the type ACTION, such as action.gripper, and lerobot's policies skip those.
    kind, action = features.get(ACTION, ("", ()))
    cameras = {key: shape for key, (kind, shape) in features.items() if kind == "VISUAL"}
    others = {key: shape for key, (kind, shape) in features.items() if kind == "ENV" and environment}
    if kind != "ACTION" or len(action) != 1:
        raise settings.error(f"output_features are {features!s:.300}; expected one vector, 'action'")
    if not (stateless and STATE not in features) and len(features.get(STATE, ("", ()))[1]) != 1:
        raise settings.error(f"input_features have no vector {STATE!r}, which this policy needs")
    if others and (list(others) != [ENVIRONMENT] or len(others[ENVIRONMENT]) != 1):
        raise settings.error(f"input_features of the environment are {others!s:.300}; expected one, {ENVIRONMENT!r}")
    if (len(set(cameras.values())) > 1 and not chunked) or any(
        len(shape) != 3 or shape[0] != 3 for shape in cameras.values()
    ):
        raise settings.error(f"cameras have the shapes {cameras!s:.300}; expected the same [3, height, width] of all")
    if len(cameras) > MOST_CAMERAS or any(max(shape) > MOST_PIXELS for shape in cameras.values()):
        raise settings.error(
            f"there are {len(cameras)} cameras of {next(iter(cameras.values()))}; expected {MOST_CAMERAS} at most, of"
            f" {MOST_PIXELS} pixels a side at most"
        )
    config = LeRobotConfig(
        directory=directory,
        settings=settings,
        features={key: features[key] for key in (STATE, *cameras, *others, ACTION) if key in features},
        n_obs_steps=1 if chunked else settings.number("n_obs_steps", 2, MOST_STEPS),
        horizon=settings.number("chunk_size" if chunked else "horizon", horizon, MOST_STEPS),
        n_action_steps=settings.number("n_action_steps", n_action_steps, MOST),
    )
    if config.n_obs_steps > config.horizon:
        raise settings.error(f"n_obs_steps is longer than the horizon, {config.horizon}")
    if chunked and config.n_action_steps > config.horizon:
        raise settings.error(
            f"n_action_steps is {config.n_action_steps}; expected chunk_size = {config.horizon} at most"
        )
    return config


def _features(settings: Settings, name: str) -> dict[str, tuple[str, tuple[int, ...]]]:
    entries = settings.values.get(name)
    if not isinstance(entries, dict):
        raise settings.refusal(name, "type and shape by name")
    found = {}
    for key, entry in entries.items():
        shape: Any = entry.get("shape") if isinstance(entry, dict) else None
        if not is_shape(shape, MOST):
            expected = f"a type and a shape of sizes up to {MOST}"
            raise settings.error(f"{name}.{key:.80} is {entry!r:.80}; expected {expected}")
        found[key] = (str(entry.get("type")), tuple(shape))
    return found
