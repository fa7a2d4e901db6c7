"""Run lerobot's eo1 at tiny sizes on seeded weights: ``lerobot_eo1.npz``, and the folder ``lerobot_eo1``.

Not run by the tests. Needs lerobot 0.6.1 with its extra eo1; this repository has to be importable::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_eo1
"""

import json
import os
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.eo1.configuration_eo1 import EO1Config
from lerobot.policies.eo1.modeling_eo1 import EO1Policy
from lerobot.policies.eo1.processor_eo1 import make_eo1_pre_post_processors
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import load_file
from transformers import (
    PreTrainedTokenizerFast,
    Qwen2_5_VLConfig,
    Qwen2_5_VLForConditionalGeneration,
    Qwen2_5_VLProcessor,
    Qwen2VLImageProcessor,
    Qwen2VLVideoProcessor,
)

from .. import eo1s, groots
from ..vlas import CAMERAS, STATE
from .tiny_qwen3_vl import SPECIAL, TEMPLATE, of_bytes

ADDED = 7
"""Tokens that lerobot adds, which have to have rows in the embedding."""
VISION: dict[str, Any] = {
    "hidden_size": 16,
    "intermediate_size": 24,
    "num_heads": 2,
    "depth": 3,
    "patch_size": 4,
    "out_hidden_size": 24,
    "window_size": 16,
    "fullatt_block_indexes": [1],
}
TEXT: dict[str, Any] = {
    "hidden_size": 24,
    "intermediate_size": 40,
    "num_hidden_layers": 3,
    "num_attention_heads": 2,
    "num_key_value_heads": 1,
    "max_position_embeddings": 512,
}
ROPE: dict[str, Any] = {"rope_type": "default", "rope_theta": 1e6, "mrope_section": [2, 2, 2]}
BACKBONES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "plain": ({}, {"rope_parameters": ROPE}),
    "deep": (
        {"window_size": 8, "fullatt_block_indexes": [0, 2], "num_heads": 4},
        {
            "rope_parameters": ROPE | {"rope_theta": 1e4, "mrope_section": [1, 3, 2]},
            "num_key_value_heads": 2,
            "rms_norm_eps": 1e-3,
        },
    ),
}
POLICIES: dict[str, dict[str, Any]] = {
    "plain": {"image_min_pixels": 8 * 64, "image_max_pixels": 12 * 64, "n_action_steps": 4},
    "deep": {
        "image_min_pixels": 14 * 64,
        "image_max_pixels": 26 * 64,
        "n_action_steps": eo1s.HORIZON,
        "num_denoise_steps": 3,
        "num_action_layers": 3,
        "action_act": "gelu",
        "min_period": 1e-2,
        "max_period": 3.0,
        "use_fast_processor": True,
    },
}


@torch.no_grad()
def main() -> None:
    """Both."""
    torch.set_num_threads(1)
    numbers: dict[str, Any] = {}
    shutil.rmtree(eo1s.SAVED, ignore_errors=True)
    for kind in eo1s.KINDS:
        folder = eo1s.SAVED / kind
        folder.mkdir(parents=True)
        os.chdir(folder)
        backbone(kind)
        for call in (0, 1):
            numbers[f"{kind}.{call}"] = chunk(save(kind), call, eo1s.observation(kind, call))
        # lerobot refuses an observation without a camera: this is the policy that never had it.
        given = {key: value for key, value in eo1s.observation(kind, 0).items() if key != CAMERAS[0]}
        numbers[f"{kind}.missing"] = chunk(save(kind, CAMERAS[1:]), 0, given)
        shutil.rmtree("policy")
        save(kind)
        (folder / "policy" / "model.safetensors").unlink()
        (folder / eo1s.BACKBONE / "model.safetensors").unlink()
    path = Path(__file__).with_name("lerobot_eo1.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def backbone(kind: str) -> None:
    """A tiny Qwen2.5-VL; of its tokenizer every byte is a token."""
    made = of_bytes()
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=made, pad_token=SPECIAL[0])
    settings: dict[str, Any] = {"patch_size": 4, "merge_size": 2, "min_pixels": 4 * 64, "max_pixels": 20 * 64}
    pictures, videos = Qwen2VLImageProcessor(**settings), Qwen2VLVideoProcessor(**settings)
    Qwen2_5_VLProcessor(pictures, tokenizer, videos, chat_template=TEMPLATE).save_pretrained(eo1s.BACKBONE)
    vision, text = BACKBONES[kind]
    ids = made.get_vocab()
    config = Qwen2_5_VLConfig(
        vision_config=VISION | vision,
        text_config=TEXT | text | {"vocab_size": len(tokenizer) + ADDED + 3, "pad_token_id": None},
        image_token_id=ids["<|image_pad|>"],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
        tie_word_embeddings=True,
    )
    Qwen2_5_VLForConditionalGeneration(config).save_pretrained(eo1s.BACKBONE)


def save(kind: str, cameras: tuple[str, ...] = CAMERAS) -> Any:
    """lerobot's policy with these cameras, saved by lerobot, with the weights of ``eo1s``."""
    features = {STATE: PolicyFeature(FeatureType.STATE, (eo1s.STATE_DIM,))}
    sizes = dict(zip(CAMERAS, eo1s.SIZES[kind][0], strict=True))
    features |= {key: PolicyFeature(FeatureType.VISUAL, (3, *sizes[key])) for key in cameras}
    config = EO1Config(
        **POLICIES[kind],
        vlm_base=f"./{eo1s.BACKBONE}",
        dtype="float32",
        chunk_size=eo1s.HORIZON,
        max_state_dim=eo1s.STATE_PADDED,
        max_action_dim=eo1s.PADDED,
        device="cpu",
        input_features=features,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (eo1s.ACTION_DIM,))},
    )
    policy = EO1Policy(config).eval()
    policy.save_pretrained("policy")
    shapes = {name: list(value.shape) for name, value in load_file("policy/model.safetensors").items()}
    loaded = policy.load_state_dict(eo1s.weights(shapes), strict=False)
    assert not loaded.unexpected_keys, loaded
    assert loaded.missing_keys == ["model.vlm_backbone.model.language_model.embed_tokens.weight"], loaded  # tied
    statistics: dict[str, dict[str, torch.Tensor]] = {}
    for key, count in ((STATE, eo1s.STATE_DIM), ("action", eo1s.ACTION_DIM)):
        low = torch.linspace(-1.5, 0.5, count)
        statistics[key] = {"mean": low, "std": low.abs() + 0.5, "min": low, "max": low + 2}
    for pipeline in make_eo1_pre_post_processors(config, statistics):
        pipeline.save_pretrained("policy")
    Path("policy", groots.SHAPES).write_text(json.dumps(shapes))
    return policy


def chunk(policy: Any, call: int, given: dict[str, Any]) -> Any:
    """The actions of a whole chunk in robot units."""
    before, after = make_pre_post_processors(policy.config, pretrained_path="policy")
    batch = before({**{key: torch.from_numpy(value) for key, value in given.items()}, "task": eo1s.TASKS[call]})
    with patch("torch.normal", lambda *_, **__: torch.from_numpy(eo1s.noise())):
        return after(policy.predict_action_chunk(batch)).numpy()


if __name__ == "__main__":
    main()
