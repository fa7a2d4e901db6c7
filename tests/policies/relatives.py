"""Tiny policies whose actions are relative to the state, saved as lerobot does: those of ``pis`` and others.

``golden/make_lerobot_relative.py`` gives lerobot the same directories, observations and noise.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from . import groots, pis, vla_jepas
from .lerobot_tiny import change_json, write_json
from .vlas import STATE, Array

NAMES = ("pan.pos", "lift.pos", "Gripper.pos", "roll.pos", "left_gripper")
"""Of the actions of pi0 and pi0.5; two of them are absolute."""
EXCLUDED = ["gripper"]
STATE_DIMS = {"pi0": 6, "pi05": 6, "vla_jepa": 8}
"""More numbers than an action has."""
WIDE = ("a", "b", "c", "d", "e", "f", "gripper")
"""Of the actions of VLA-JEPA."""
RELATIVE, ABSOLUTE = "relative_actions_processor", "absolute_actions_processor"
STEPS = groots.HORIZON
"""Of the statistics of GR00T's relative actions."""


def state(kind: str, call: int) -> Array:
    """Of one stream."""
    return np.random.RandomState(call + 40).uniform(-3, 3, STATE_DIMS[kind]).astype(np.float32)


def observation(kind: str, call: int) -> dict[str, Array]:
    """One frame of one stream, without its axis."""
    if kind == "groot":
        return groots.observation(call)
    if kind == "vla_jepa":
        return vla_jepas.observation("libero", call) | {STATE: state(kind, call)}
    return {key: value[0] for key, value in pis.observation(call).items()} | {STATE: state(kind, call)}


def committed() -> Array:
    """Actions that the robot is about to execute when pi0.5 is called, ``[1, N, Da]``, in its own units."""
    moves = np.random.RandomState(6).uniform(-0.4, 0.4, (1, pis.TRAINED, pis.ACTION_DIM))
    return (moves + state("pi05", 0)[: pis.ACTION_DIM]).astype(np.float32)


def save(kind: str, folder: Path) -> Path:
    """Save ``pi0``, ``pi05``, ``vla_jepa`` or ``groot``. Returns the policy's directory."""
    if kind == "groot":
        return with_relative_groups(groots.save("native", folder))
    if kind == "vla_jepa":
        return with_relative_steps(with_wide_state(vla_jepas.save("libero", folder), kind), list(WIDE))
    directory = with_relative_steps(with_wide_state(pis.save(kind, folder / "policy"), kind), list(NAMES))
    if kind == "pi05":
        change_json(directory / "config.json", rtc_training_max_delay=pis.TRAINED)
    return directory


def pipelines(directory: Path) -> tuple[Path, Path]:
    """The files of both."""
    return directory / "policy_preprocessor.json", directory / "policy_postprocessor.json"


def change_group(directory: Path, number: int, changes: dict[str, Any]) -> None:
    """Change how a group of GR00T's actions is configured, in both pipelines."""
    for path in pipelines(directory):
        pipeline = json.loads(path.read_text())
        for step in pipeline["steps"]:
            if "modality_config" in step["config"]:
                step["config"]["modality_config"]["action"]["action_configs"][number] |= changes
        change_json(path, steps=pipeline["steps"])


def with_wide_state(directory: Path, kind: str) -> Path:
    """Give a policy a state that is as wide as ``STATE_DIMS`` says. pi0 pads it; VLA-JEPA has a layer for it."""
    width, path = STATE_DIMS[kind], directory / "model.safetensors"
    feature = {STATE: {"type": "STATE", "shape": [width]}}
    config = json.loads((directory / "config.json").read_text())
    change_json(directory / "config.json", input_features=config["input_features"] | feature)
    if kind == "vla_jepa":
        first = "model.action_model.state_encoder.layer1.weight"
        shapes = {name: list(value.shape) for name, value in load_file(path).items()}
        path.unlink()  # it is mapped
        save_file(vla_jepas.weights(shapes | {first: [shapes[first][0], width]}), path)
        change_json(directory / "config.json", state_dim=width)
    numbers = torch.linspace(-1.5, 0.5, width)
    own = {f"{STATE}.{name}": numbers.clone() for name in ("mean", "q01", "min")}
    own |= {f"{STATE}.std": numbers.abs() + 0.5, f"{STATE}.q99": numbers + 2, f"{STATE}.max": numbers + 2}
    for file in pipelines(directory):
        pipeline = json.loads(file.read_text())
        for step in pipeline["steps"]:
            if "features" in step["config"]:
                step["config"]["features"] |= feature
        write_json(file, pipeline)
    for file in directory.glob("*.safetensors"):
        if file != path:
            statistics = load_file(file) | own
            file.unlink()
            save_file(statistics, file)
    return directory


def with_relative_steps(directory: Path, names: list[str] | None, excluded: list[str] = EXCLUDED) -> Path:
    """Put lerobot's pair of steps around a policy, where its own maker of processors puts them."""
    own = {"enabled": True, "exclude_joints": excluded, "action_names": names}
    pair = ((RELATIVE, own, "normalizer_processor", 0), (ABSOLUTE, {"enabled": True}, "unnormalizer_processor", 1))
    for file, (name, config, beside, after) in zip(pipelines(directory), pair, strict=True):
        steps = json.loads(file.read_text())["steps"]
        place = [step["registry_name"] for step in steps].index(beside) + after
        change_json(file, steps=[*steps[:place], {"registry_name": name, "config": config}, *steps[place:]])
    more = {"relative_exclude_joints": excluded, "action_feature_names": names}
    change_json(directory / "config.json", use_relative_actions=True, **more)
    return directory


def with_relative_groups(directory: Path) -> Path:
    """Give GR00T's second policy groups of actions of which some are relative; one has a range for each step."""
    rng = np.random.RandomState(9)
    low, wide = rng.uniform(-1, 0, (STEPS, 3)), rng.uniform(0.5, 2, (STEPS, 3))
    gripper = {"min": [-0.5], "max": [0.25], "mean": [0.0], "std": [1.0]}
    arm = {"min": low.tolist(), "max": (low + wide).tolist(), "mean": low.tolist(), "std": wide.tolist()}
    lift = {"min": [0.0], "max": [9.0], "q01": [0.5], "q99": [1.5], "mean": [1.0], "std": [1.0]}
    still = {
        "min": [0.0] * 3,
        "max": [1.0] * 3,
        "q01": [0.0] * 3,
        "q99": [1.0] * 3,
        "mean": [0.5] * 3,
        "std": [1.0] * 3,
    }
    groups: list[tuple[str, dict[str, Any]]] = [
        ("gripper", {"rep": "RELATIVE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}),
        ("reach", {"rep": "relative", "type": "non_eef", "format": "default", "state_key": "arm"}),
        ("lift", {"rep": "ABSOLUTE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}),
    ]
    for file in pipelines(directory):
        pipeline = json.loads(file.read_text())
        for step in pipeline["steps"]:
            if "modality_config" in step["config"]:
                raw, action = step["config"]["raw_stats"], step["config"]["modality_config"]["action"]
                one = {name: values[:1] for name, values in still.items()}
                raw |= {"action": {"gripper": one, "reach": still, "lift": lift}}
                raw |= {"relative_action": {"gripper": gripper, "reach": arm}}
                action |= {"modality_keys": [name for name, _ in groups], "action_configs": [own for _, own in groups]}
            if "use_relative_action" in step["config"]:
                step["config"]["use_relative_action"] = True
        write_json(file, pipeline)
    change_json(directory / "config.json", use_relative_actions=True, n_action_steps=4)
    return directory
