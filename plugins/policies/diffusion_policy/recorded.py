"""Which arrays of a data set the observation was made of in training.

Source: the data sets of real-stanford/diffusion_policy, and of 3D-Diffusion-Policy and Improved-3D-Diffusion-Policy of
YanjieZe, by the names of their classes.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ttscompile.core.spec import ObservationSpec

from .interpolation import Config

_ROBOMIMIC = ["object", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]


def with_recorded(observations: Mapping[str, ObservationSpec], config: Config) -> dict[str, ObservationSpec]:
    """Observations that know what they are made of in a recording, where the training's data set is a known one."""
    parts = _parts(str(config.get("task.dataset._target_")).rpartition(".")[2], config)
    told = {key: tuple(names) for key, names in parts.items() if all(isinstance(name, str) for name in names)}
    return {key: replace(spec, recorded=told.get(key, ())) for key, spec in observations.items()}


def _parts(data_set: str, config: Config) -> Mapping[str, list[Any]]:
    """By key of the observation; nothing of a data set whose arrays have the names of the observation's keys."""
    match data_set:
        case "PushTLowdimDataset":
            state = config.get("task.dataset.state_key", "state")
            return {"obs": [config.get("task.dataset.obs_key", "keypoint"), f"{state}:2"]}
        case "PushTImageDataset":
            return {"image": ["img"], "agent_pos": ["state:2"]}
        case "RobomimicReplayLowdimDataset":
            names = config.get("task.dataset.obs_keys", _ROBOMIMIC)
            return {"obs": names if isinstance(names, list) else []}
        case "AdroitDataset" | "MetaworldDataset" | "RealDexDataset" | "DexArtDataset" | "GR1DexDataset3D":
            return {"agent_pos": ["state"]}
        case "GR1DexDatasetImage":
            return {"agent_pos": ["state"], "image": ["img"]}
    return {}
