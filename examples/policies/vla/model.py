"""The policy of ``train.py``: lerobot's ``smolvla``, with a language model and a vision transformer of a few layers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from environments.fetch_blocks import BEFORE, LENGTH, SIZE, WORDS
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import PreTrainedTokenizerFast, SmolVLMImageProcessor, SmolVLMProcessor, SmolVLMVideoProcessor

NAME = "language-model"
"""Folder of the language model's configuration and tokenizer, beside the policy's own."""
_SPECIAL = {
    "pad_token": "<|im_end|>",
    "bos_token": "<|im_start|>",
    "unk_token": "<|endoftext|>",
    "eos_token": "<end_of_utterance>",
    "fake_image_token": "<fake_token_around_image>",
    "image_token": "<image>",
    "global_image_token": "<global-img>",
    "video_token": "<video>",
}


def save_language_model(directory: Path, width: int, layers: int, patch: int) -> None:
    """Write what ``vlm_model_name`` names: configuration, tokenizer with a token a word, and the processor's files."""
    vocabulary = {token: number for number, token in enumerate([*_SPECIAL.values(), *WORDS])}
    assert vocabulary[WORDS[0]] == BEFORE
    tokenizer = Tokenizer(models.WordLevel(vocabulary, unk_token=_SPECIAL["unk_token"]))
    tokenizer.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    extra = {name: token for name, token in _SPECIAL.items() if not name.startswith(("pad", "bos", "unk", "eos"))}
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        extra_special_tokens=extra,
        **{name: token for name, token in _SPECIAL.items() if name not in extra},
    )
    parts = SmolVLMImageProcessor(), fast, SmolVLMVideoProcessor()
    SmolVLMProcessor(*parts, image_seq_len=(SIZE // patch) ** 2).save_pretrained(directory)
    text: dict[str, Any] = {
        "model_type": "llama",
        "hidden_size": width,
        "intermediate_size": 3 * width,
        "num_hidden_layers": layers,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "head_dim": width // 4,
        "vocab_size": 64,
        "pad_token_id": 0,
        "bos_token_id": 1,
        "eos_token_id": 3,
        "rms_norm_eps": 1e-5,
        "tie_word_embeddings": False,
    }
    vision: dict[str, Any] = {
        "model_type": "smolvlm_vision",
        "hidden_size": width,
        "intermediate_size": 3 * width,
        "num_hidden_layers": layers,
        "num_attention_heads": 4,
        "image_size": SIZE,
        "patch_size": patch,
    }
    config = {
        "model_type": "smolvlm",
        "scale_factor": 1,
        "image_token_id": 5,
        "pad_token_id": 0,
        "tie_word_embeddings": False,
        "text_config": text,
        "vision_config": vision,
    }
    (directory / "config.json").write_text(json.dumps(config, indent=1))


def configuration(layers: int) -> SmolVLAConfig:
    """Of the policy; ``NAME`` has to be in the working directory when it is built."""
    camera = PolicyFeature(type=FeatureType.VISUAL, shape=(3, SIZE, SIZE))
    return SmolVLAConfig(
        input_features={
            "observation.images.front": camera,
            "observation.images.wrist": camera,
            "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(4,)),
        },
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(4,))},
        device="cpu",
        push_to_hub=False,
        chunk_size=16,
        n_action_steps=8,
        max_state_dim=8,
        max_action_dim=8,
        resize_imgs_with_padding=(SIZE, SIZE),
        tokenizer_max_length=LENGTH,
        pad_language_to="max_length",
        num_steps=10,
        freeze_vision_encoder=False,
        train_expert_only=False,
        vlm_model_name=NAME,
        num_vlm_layers=layers,
        self_attn_every_n_layers=2,
        expert_width_multiplier=0.75,
    )
