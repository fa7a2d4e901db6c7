"""A Qwen3-VL so small that golden files of it are: sizes, and the files of its processor. Needs transformers."""

import shutil
from pathlib import Path
from typing import Any

from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import PreTrainedTokenizerFast, Qwen3VLVideoProcessor

TEMPLATE = """{%- for message in messages -%}
{{- '<|im_start|>' + message.role + '\\n' -}}
{%- for content in message.content -%}
{%- if content.type == 'image' -%}{{- '<|vision_start|><|image_pad|><|vision_end|>' -}}
{%- elif 'text' in content -%}{{- content.text -}}{%- endif -%}
{%- endfor -%}
{{- '<|im_end|>\\n' -}}
{%- endfor -%}"""
"""What Qwen3-VL's says of a message of a user, and Qwen2.5-VL's of messages of which the first is the system's."""
SPECIAL = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>"]
SPECIAL += ["<|video_pad|>"]
VISION: dict[str, Any] = {
    "hidden_size": 16,
    "intermediate_size": 24,
    "num_heads": 2,
    "depth": 3,
    "patch_size": 4,
    "out_hidden_size": 24,
    "num_position_embeddings": 25,
}
TEXT: dict[str, Any] = {
    "hidden_size": 24,
    "intermediate_size": 40,
    "num_hidden_layers": 4,
    "num_attention_heads": 4,
    "num_key_value_heads": 2,
    "head_dim": 12,
}


def of_bytes() -> Tokenizer:
    """A tokenizer of which every byte is a token."""
    vocabulary = {letter: i for i, letter in enumerate(sorted(pre_tokenizers.ByteLevel.alphabet()))}
    made = Tokenizer(models.BPE(vocab=vocabulary, merges=[]))
    made.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    made.add_special_tokens(SPECIAL)
    return made


def save_processor(folder: Path, pictures: Any) -> dict[str, int]:
    """Write tokenizer and processors; ``pictures`` is the class of that of pictures. The numbers of its tokens."""
    made = of_bytes()
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=made, pad_token=SPECIAL[0], chat_template=TEMPLATE)
    tokenizer.save_pretrained(folder)
    half, size = [0.5] * 3, {"shortest_edge": 64, "longest_edge": 4096}
    settings: dict[str, Any] = {"patch_size": 4, "merge_size": 2, "image_mean": half, "image_std": half, "size": size}
    pictures(**settings).save_pretrained(folder)
    own = folder / "preprocessor_config.json"
    shutil.copy(own, folder / "own.json")
    Qwen3VLVideoProcessor(**settings).save_pretrained(folder)  # which writes over it
    (folder / "own.json").rename(own)
    ids: dict[str, int] = made.get_vocab()
    return ids


def tokens_of(ids: dict[str, int]) -> dict[str, int]:
    """The entries of a ``Qwen3VLConfig`` for pictures."""
    named = ("image_token", "video_token", "vision_start_token", "vision_end_token")
    words = ("<|image_pad|>", "<|video_pad|>", "<|vision_start|>", "<|vision_end|>")
    return {f"{name}_id": ids[word] for name, word in zip(named, words, strict=True)}
