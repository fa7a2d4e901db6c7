"""Tiny policies with random weights that LeRobot's own classes make and save. Needs lerobot."""

from pathlib import Path
from typing import Any

import torch

STATE, ENVIRONMENT = "observation.state", "observation.environment_state"
DS, DA, PIXELS = 2, 2, 96
"""As Push-T has them."""
TOP = "observation.images.top"
CAMERAS = {"diffusion": "observation.image", "multi_task_dit": TOP, "act": TOP}
"""By case; that of Push-T, and that of ``still_robot``."""

CLIP = {"hidden_size": 8, "intermediate_size": 12, "num_hidden_layers": 1, "num_attention_heads": 2}

SETTINGS: dict[str, dict[str, Any]] = {
    "diffusion": {
        "crop_shape": (20, 20),
        "pretrained_backbone_weights": None,
        "use_group_norm": True,
        "down_dims": (8, 16),
        "n_groups": 4,
        "kernel_size": 3,
        "diffusion_step_embed_dim": 8,
        "spatial_softmax_num_keypoints": 4,
        "noise_scheduler_type": "DDIM",
        "num_inference_steps": 3,
    },
    "diffusion, DDPM, one frame": {
        "n_obs_steps": 1,
        "down_dims": (8, 16),
        "n_groups": 4,
        "kernel_size": 3,
        "diffusion_step_embed_dim": 8,
        "num_train_timesteps": 8,
        "beta_schedule": "linear",  # squaredcos over so few steps divides rounding errors by a hundredth
        "beta_start": 0.01,
        "beta_end": 0.2,
    },
    "multi_task_dit": {
        "objective": "flow_matching",
        "num_integration_steps": 3,
        "n_obs_steps": 1,
        "hidden_dim": 16,
        "num_layers": 2,
        "num_heads": 2,
        "timestep_embed_dim": 8,
        "image_crop_shape": (16, 16),
        "tokenizer_max_length": 9,
    },
    "act": {
        "chunk_size": 8,
        "pretrained_backbone_weights": None,
        "dim_model": 16,
        "n_heads": 2,
        "dim_feedforward": 24,
        "n_encoder_layers": 2,
        "n_vae_encoder_layers": 1,
        "latent_dim": 4,
    },
}
"""By case; its first word is the type."""


def save(case: str, folder: Path) -> Path:
    """Make a policy with its processors and save it, as lerobot's training does; gives its directory."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors

    kind, settings = case.partition(",")[0], dict(SETTINGS[case])
    inputs = {STATE: PolicyFeature(FeatureType.STATE, (DS,))}
    if case in CAMERAS:
        inputs[CAMERAS[case]] = PolicyFeature(FeatureType.VISUAL, (3, PIXELS, PIXELS))
    else:
        inputs[ENVIRONMENT] = PolicyFeature(FeatureType.ENV, (3,))
    if kind == "multi_task_dit":
        settings |= dict.fromkeys(("vision_encoder_name", "text_encoder_name"), str(_clip(folder / "clip")))
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (DA,))}
    if "chunk_size" not in settings:
        settings["horizon"] = 8
    config = make_policy_config(
        kind, input_features=inputs, output_features=outputs, n_action_steps=4, device="cpu", **settings
    )
    torch.manual_seed(0)
    policy, directory = get_policy_class(kind)(config), folder / "policy"
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.1)
    policy.save_pretrained(directory)
    for pipeline in make_pre_post_processors(config, dataset_stats=_statistics(inputs | outputs)):
        pipeline.save_pretrained(directory)
    return directory


def _statistics(features: dict[str, Any]) -> dict[str, dict[str, torch.Tensor]]:
    found = {}
    for key, feature in features.items():
        shape = (3, 1, 1) if feature.type.name == "VISUAL" else feature.shape
        low, width = torch.randn(shape), torch.rand(shape) + 0.5
        found[key] = {"min": low, "max": low + width, "mean": low + width / 2, "std": width / 3}
    return found


def _clip(folder: Path) -> Path:
    """CLIP of almost no size, with a tokenizer of a few words."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import CLIPConfig, CLIPModel, PreTrainedTokenizerFast

    vision = CLIP | {"image_size": 16, "patch_size": 8}
    text = CLIP | {"vocab_size": 8, "max_position_embeddings": 9, "eos_token_id": 7, "bos_token_id": 6}
    torch.manual_seed(1)
    CLIPModel(CLIPConfig(text_config=text, vision_config=vision, projection_dim=8)).save_pretrained(folder)
    words = ["<pad>", "push", "the", "block", "pull", "it", "<start>", "<end>"]
    tokenizer = Tokenizer(models.WordLevel({word: i for i, word in enumerate(words)}, unk_token="it"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    ends = [("<start>", 6), ("<end>", 7)]
    tokenizer.post_processor = processors.TemplateProcessing(single="<start> $A <end>", special_tokens=ends)
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token="<pad>").save_pretrained(folder)
    return folder
