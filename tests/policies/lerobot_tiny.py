"""Tiny LeRobot policies with random weights, saved as lerobot saves them."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors.torch import load_file, save_file

from ttscompile.policies.lerobot.multi_task_dit import MultiTaskDiTConfig, Network, read_config
from ttscompile.policies.networks.clip import TextConfig, VisionConfig

TO, DS, DA, SIDE = 2, 5, 3, 24

VISION: dict[str, Any] = {"hidden_size": 8, "intermediate_size": 12, "num_hidden_layers": 1, "num_attention_heads": 2}
VISION |= {"image_size": 16, "patch_size": 8}
TEXT: dict[str, Any] = {"hidden_size": 8, "intermediate_size": 12, "num_hidden_layers": 1, "num_attention_heads": 2}
TEXT |= {"vocab_size": 20, "max_position_embeddings": 9, "eos_token_id": 19}

_BASE: dict[str, Any] = {
    "type": "multi_task_dit",
    "n_obs_steps": TO,
    "horizon": 8,
    "n_action_steps": 4,
    "objective": "diffusion",
    "noise_scheduler_type": "DDIM",
    "num_train_timesteps": 20,
    "num_inference_steps": 4,
    "beta_schedule": "squaredcos_cap_v2",
    "beta_start": 0.0001,
    "beta_end": 0.02,
    "prediction_type": "epsilon",
    "clip_sample": True,
    "clip_sample_range": 1.0,
    "num_integration_steps": 3,
    "integration_method": "euler",
    "hidden_dim": 16,
    "num_layers": 2,
    "num_heads": 2,
    "timestep_embed_dim": 8,
    "use_positional_encoding": False,
    "use_rope": True,
    "rope_base": 10000.0,
    "vision_encoder_name": "somebody/clip-small",
    "text_encoder_name": "somebody/clip-small",
    "use_separate_rgb_encoder_per_camera": False,
    "image_resize_shape": None,
    "image_crop_shape": [16, 16],
    "tokenizer_max_length": 9,
}


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file."""
    path.write_text(json.dumps(content), encoding="utf-8")


def change_json(path: Path, **changes: Any) -> None:
    """Change entries of a JSON file."""
    write_json(path, json.loads(path.read_text(encoding="utf-8")) | changes)


def changed_policy(
    saved: Path, directory: Path, weights: Callable[[dict[str, torch.Tensor]], object] | None = None, **entries: Any
) -> Path:
    """Save a policy again with other entries of its ``config.json``, and with weights that ``weights`` changes."""
    directory.mkdir()
    for file in saved.iterdir():
        if file.name != "config.json" and (file.name != "model.safetensors" or weights is None):
            (directory / file.name).symlink_to(file)
    write_json(directory / "config.json", json.loads((saved / "config.json").read_text(encoding="utf-8")) | entries)
    if weights is not None:
        tensors = load_file(saved / "model.safetensors")
        weights(tensors)
        save_file(tensors, directory / "model.safetensors")
    return directory


def save_variant(
    directory: Path,
    made: Mapping[str, Any],
    features: Mapping[str, tuple[str, list[int]]],
    base: Mapping[str, Any],
    weights: Callable[[Path], dict[str, torch.Tensor]],
) -> Path:
    """Save a policy of a type that has several variants.

    Args:
        directory: of the policy.
        made: ``inputs``, ``modes``, ``settings`` and, of what the robot calls otherwise, ``renamed`` of the variant.
        features: type and shape of all that it reads, and of its action.
        base: entries of ``config.json`` that are common to the variants.
        weights: ``weights(directory)``, of what is saved there.

    Returns:
        The directory.
    """
    directory.mkdir(parents=True)
    described = {key: {"type": kind, "shape": shape} for key, (kind, shape) in features.items()}
    outputs = {"action": described["action"]}
    inputs = {key: each for key, each in described.items() if key not in outputs}
    own = {"input_features": inputs, "output_features": outputs, "normalization_mapping": made["modes"]}
    write_json(directory / "config.json", {**base, **own, **made["settings"]})
    statistics: dict[str, torch.Tensor] = {}
    for key, (kind, shape) in features.items():
        of = (shape[0], 1, 1) if kind == "VISUAL" else tuple(shape)
        low, width = torch.linspace(-0.3, 0.2, shape[0]).reshape(of), torch.linspace(0.7, 1.4, shape[0]).reshape(of)
        statistics |= {f"{key}.{name}": low.clone() for name in ("min", "q01", "q10", "mean")}
        statistics |= {f"{key}.{name}": low + width for name in ("max", "q99", "q90")} | {f"{key}.std": width}
    write_processors(directory, described, made["modes"], made.get("renamed", {}), statistics)
    save_file(weights(directory), directory / "model.safetensors")
    return directory


def observe_variant(made: Mapping[str, Any], shapes: Mapping[str, tuple[int, ...]]) -> dict[str, npt.NDArray[Any]]:
    """Windows of these shapes by the robot's names, images in 0..1."""
    robots = {new: old for old, new in made.get("renamed", {}).items()}
    rng = np.random.RandomState(7)
    return {robots.get(key, key): rng.uniform(0, 1, shape).astype(np.float32) for key, shape in shapes.items()}


def save_policy(
    folder: Path,
    cameras: tuple[str, ...] = (),
    modes: tuple[str, str, str] = ("MEAN_STD", "MIN_MAX", "MIN_MAX"),
    renamed: dict[str, str] | None = None,
    **changes: Any,
) -> Path:
    """Save a policy and, beside it, the configuration of its CLIP encoders.

    Args:
        folder: empty; the policy goes to ``folder / "policy"``.
        cameras: names of the cameras, after ``observation.images.``.
        modes: of normalising images, state and action.
        renamed: ``rename_map`` of the preprocessor.
        **changes: of ``config.json``.

    Returns:
        The directory of the policy.
    """
    directory, encoder = folder / "policy", folder / "clip-small"
    directory.mkdir()
    encoder.mkdir(exist_ok=True)
    write_json(encoder / "config.json", {"model_type": "clip", "vision_config": VISION, "text_config": TEXT})
    images = [f"observation.images.{name}" for name in cameras]
    inputs = {"observation.state": {"type": "STATE", "shape": [DS]}}
    inputs |= {key: {"type": "VISUAL", "shape": [3, SIDE, SIDE]} for key in images}
    outputs = {"action": {"type": "ACTION", "shape": [DA]}}
    write_json(directory / "config.json", _BASE | {"input_features": inputs, "output_features": outputs} | changes)

    generator = torch.Generator().manual_seed(len(changes))
    norm_map = dict(zip(("VISUAL", "STATE", "ACTION"), modes, strict=True))
    write_processors(directory, inputs | outputs, norm_map, renamed or {}, _statistics(generator, images))
    save_file(_weights(directory, generator), directory / "model.safetensors")
    return directory


def write_processors(
    directory: Path,
    features: dict[str, Any],
    norm_map: dict[str, str],
    renamed: dict[str, str],
    statistics: dict[str, torch.Tensor],
) -> None:
    """Save both pipelines of a policy and their statistics."""
    normalizer = {"eps": 1e-8, "features": features, "norm_map": norm_map}
    save_file(statistics, directory / "before.safetensors")
    save_file(statistics, directory / "after.safetensors")
    before = [
        {"registry_name": "rename_observations_processor", "config": {"rename_map": renamed}},
        {"registry_name": "to_batch_processor", "config": {}},
        {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}},
        {"registry_name": "normalizer_processor", "config": normalizer, "state_file": "before.safetensors"},
    ]
    after = [{"registry_name": "unnormalizer_processor", "config": normalizer, "state_file": "after.safetensors"}]
    write_json(directory / "policy_preprocessor.json", {"name": "policy_preprocessor", "steps": before})
    write_json(directory / "policy_postprocessor.json", {"name": "policy_postprocessor", "steps": after})


def _statistics(generator: torch.Generator, images: list[str]) -> dict[str, torch.Tensor]:
    """Every statistic of every feature; the last channel of state and action never changed."""
    found: dict[str, torch.Tensor] = {}
    for key, width in (("observation.state", DS), ("action", DA), *((image, 3) for image in images)):
        shape = (width, 1, 1) if key in images else (width,)
        low, spread = torch.randn(shape, generator=generator), torch.rand(shape, generator=generator) + 0.5
        if key not in images:
            spread[-1] = 0
        found |= {f"{key}.min": low, f"{key}.max": low + spread, f"{key}.mean": low + spread / 2, f"{key}.std": spread}
        found |= {
            f"{key}.q01": low + 0.01,
            f"{key}.q99": low + spread,
            f"{key}.q10": low - 0.01,
            f"{key}.q90": low + spread,
        }
    return found


def _weights(directory: Path, generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Random weights under the names that lerobot with transformers 4 saves."""
    config = dit_config(directory)
    vision = VisionConfig(**VISION) if config.cameras else None
    found = {}
    for name, value in Network(config, vision, TextConfig(**TEXT)).state_dict().items():
        key = name.replace("encoder.model.", "encoder.model.vision_model.")
        key = key.replace(".text_encoder.text_encoder.", ".text_encoder.text_encoder.text_model.")
        for i in range(9):
            key = key.replace(f"vision_encoders.{i}.model.", f"vision_encoders.{i}.model.vision_model.")
        found[key] = torch.randn(value.shape, generator=generator) * 0.4
    return found


def dit_config(directory: Path) -> MultiTaskDiTConfig:
    """The configuration as it is read."""
    return read_config(directory, json.loads((directory / "config.json").read_text(encoding="utf-8")))
