"""Run lerobot's vla_jepa at tiny sizes on seeded weights: ``lerobot_vla_jepa.npz``, and the folder of this name.

Not run by the tests. Needs lerobot 0.6.1 with its extra vla-jepa; this repository has to be importable::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_vla_jepa
"""

import json
import os
import shutil
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.vla_jepa import modeling_vla_jepa
from lerobot.policies.vla_jepa.configuration_vla_jepa import VLAJEPAConfig
from lerobot.policies.vla_jepa.modeling_vla_jepa import VLAJEPAPolicy
from lerobot.policies.vla_jepa.processor_vla_jepa import make_vla_jepa_pre_post_processors
from safetensors.torch import load_file
from transformers import (
    PreTrainedTokenizerFast,
    Qwen2VLImageProcessor,
    Qwen3VLConfig,
    Qwen3VLForConditionalGeneration,
    Qwen3VLProcessor,
    Qwen3VLVideoProcessor,
    VJEPA2Config,
    VJEPA2Model,
    VJEPA2VideoProcessor,
)

from .. import groots, vla_jepas
from ..vlas import CAMERAS, STATE
from .tiny_qwen3_vl import SPECIAL, TEMPLATE, TEXT, VISION, of_bytes

VIDEO = "vjepa2-tiny"
TEMPLATE += "{%- if add_generation_prompt -%}{{- '<|im_start|>assistant\\n' -}}{%- endif -%}"
AUTOCAST = next(name for name in ("_get_autocast_context", "get_autocast_context") if hasattr(modeling_vla_jepa, name))
"""Of lerobot 0.6.1, or as it is called later."""
ROPE: dict[str, Any] = {"rope_type": "default", "rope_theta": 5e6, "mrope_section": [2, 2, 2]}
BACKBONES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "libero": ({"deepstack_visual_indexes": [0, 2]}, {"rope_parameters": ROPE}),
    "plain": (
        {"deepstack_visual_indexes": [2, 0, 1], "num_heads": 4},
        {"rope_parameters": ROPE | {"rope_theta": 1e4, "mrope_section": [4, 1, 1]}, "num_hidden_layers": 3},
    ),
}
POLICIES: dict[str, dict[str, Any]] = {
    "libero": {
        "resize_images_to": (20, 28),
        "enable_world_model": True,
        "jepa_encoder_name": f"./{VIDEO}",
        "predictor_depth": 1,
        "predictor_num_heads": 2,
        "num_action_tokens_per_timestep": 2,
        "num_embodied_action_tokens_per_instruction": 3,
        "action_model_type": "DiT-test",
        "n_action_steps": 3,
    },
    "plain": {
        "enable_world_model": False,
        "num_embodied_action_tokens_per_instruction": 5,
        "prompt_template": "Do {instruction} at once: {e_actions}, please.",
        "action_num_heads": 3,
        "action_attention_head_dim": 6,
        "num_inference_timesteps": 3,
        "n_action_steps": vla_jepas.HORIZON,
        "pre_snap_gripper_action": False,
        "clip_normalized_actions": False,
        "normalization_mapping": {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        },
    },
}


@torch.no_grad()
def main() -> None:
    """Both."""
    torch.set_num_threads(1)
    numbers: dict[str, Any] = {}
    shutil.rmtree(vla_jepas.SAVED, ignore_errors=True)
    for kind in vla_jepas.KINDS:
        folder = vla_jepas.SAVED / kind
        folder.mkdir(parents=True)
        os.chdir(folder)
        backbone(kind)
        video()
        policy = save(kind)
        for call in (0, 1):
            numbers[f"{kind}.{call}"] = chunk(policy, call, vla_jepas.observation(kind, call))
        # lerobot refuses an observation without a camera: this is the network that never had it.
        del policy.config.input_features[CAMERAS[0]]
        given = {key: value for key, value in vla_jepas.observation(kind, 0).items() if key != CAMERAS[0]}
        numbers[f"{kind}.missing"] = chunk(policy, 0, given)
        (folder / "policy" / "model.safetensors").unlink()
        (folder / vla_jepas.BACKBONE / "model.safetensors").unlink()
        shutil.rmtree(VIDEO)
    path = Path(__file__).with_name("lerobot_vla_jepa.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def backbone(kind: str) -> None:
    """A tiny Qwen3-VL; of its tokenizer every byte is a token."""
    made = of_bytes()
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=made, pad_token=SPECIAL[0])
    half, size = [0.5] * 3, {"shortest_edge": 512, "longest_edge": 1024}
    settings: dict[str, Any] = {"patch_size": 4, "merge_size": 2, "image_mean": half, "image_std": half, "size": size}
    pictures, videos = Qwen2VLImageProcessor(**settings), Qwen3VLVideoProcessor(**settings)
    Qwen3VLProcessor(pictures, tokenizer, videos, chat_template=TEMPLATE).save_pretrained(vla_jepas.BACKBONE)
    vision, text = BACKBONES[kind]
    ids = made.get_vocab()
    spare = 40 if kind == "plain" else 0  # otherwise lerobot adds rows
    config = Qwen3VLConfig(
        vision_config=VISION | vision,
        text_config=TEXT | text | {"vocab_size": len(tokenizer) + spare, "pad_token_id": None},
        image_token_id=ids["<|image_pad|>"],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
        tie_word_embeddings=True,
    )
    Qwen3VLForConditionalGeneration(config).save_pretrained(vla_jepas.BACKBONE)


def video() -> None:
    """A tiny V-JEPA."""
    VJEPA2Model(
        VJEPA2Config(
            patch_size=16,
            crop_size=32,
            frames_per_clip=4,
            tubelet_size=2,
            hidden_size=12,
            num_attention_heads=2,
            num_hidden_layers=1,
            pred_hidden_size=12,
            pred_num_attention_heads=2,
            pred_num_hidden_layers=1,
            pred_num_mask_tokens=1,
        )
    ).save_pretrained(VIDEO)
    VJEPA2VideoProcessor().save_pretrained(VIDEO)


def save(kind: str) -> Any:
    """lerobot's policy, saved by lerobot, with the weights of ``vla_jepas``."""
    sizes = zip(CAMERAS, vla_jepas.SIZES[kind][0], strict=True)
    features = {key: PolicyFeature(FeatureType.VISUAL, (3, *size)) for key, size in sizes}
    if kind == "libero":
        features = {STATE: PolicyFeature(FeatureType.STATE, (vla_jepas.STATE_DIM,)), **features}
    config = VLAJEPAConfig(
        **POLICIES[kind],
        qwen_model_name=f"./{vla_jepas.BACKBONE}",
        torch_dtype="float32",
        chunk_size=vla_jepas.HORIZON,
        action_hidden_size=18,
        action_num_layers=4,
        device="cpu",
        input_features=features,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (vla_jepas.ACTION_DIM,))},
    )
    policy = VLAJEPAPolicy(config).eval()
    policy.save_pretrained("policy")
    shapes = {name: list(value.shape) for name, value in load_file("policy/model.safetensors").items()}
    loaded = policy.load_state_dict(vla_jepas.weights(shapes), strict=False)
    assert not loaded.unexpected_keys, loaded
    assert loaded.missing_keys in ([], ["model.qwen.model.model.language_model.embed_tokens.weight"]), loaded  # tied
    statistics: dict[str, dict[str, torch.Tensor]] = {}
    for key, count in ((STATE, vla_jepas.STATE_DIM), ("action", vla_jepas.ACTION_DIM)):
        low = torch.linspace(-1.5, 0.5, count)
        statistics[key] = {"mean": low, "std": low.abs() + 0.5, "min": low, "max": low + 2}
    statistics["action"]["min"][-1] = 0.0  # of the gripper
    statistics["action"]["max"][-1] = 1.0
    for pipeline in make_vla_jepa_pre_post_processors(config, statistics):
        pipeline.save_pretrained("policy")
    Path("policy", groots.SHAPES).write_text(json.dumps(shapes))
    return policy


def chunk(policy: Any, call: int, given: dict[str, Any]) -> Any:
    """The actions of a whole chunk in robot units."""
    before, after = make_pre_post_processors(policy.config, pretrained_path="policy")
    batch = before({**{key: torch.from_numpy(value) for key, value in given.items()}, "task": vla_jepas.TASKS[call]})
    # On a processor, too, lerobot would compute in bfloat16, whatever torch_dtype says.
    with (
        patch.object(modeling_vla_jepa, AUTOCAST, lambda *_: nullcontext()),
        patch("torch.randn", lambda *_, **__: torch.from_numpy(vla_jepas.noise())),
    ):
        return after(policy.predict_action_chunk(batch)).numpy()


if __name__ == "__main__":
    main()
