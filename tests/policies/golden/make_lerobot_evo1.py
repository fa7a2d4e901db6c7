"""Run lerobot's evo1 at tiny sizes on seeded weights: ``lerobot_evo1.npz``, and the folder ``lerobot_evo1``.

Not run by the tests. Needs lerobot 0.6.1 with transformers; this repository has to be importable::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_evo1
"""

import json
import os
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.evo1 import Evo1Config, Evo1Policy, make_evo1_pre_post_processors
from lerobot.policies.factory import make_pre_post_processors
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import InternVLConfig, InternVLModel, PreTrainedTokenizerFast

from .. import evo1s
from ..vlas import CAMERAS, STATE

VISION = {
    "hidden_size": 16,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "intermediate_size": 24,
    "image_size": [28, 28],
    "patch_size": [7, 7],
}
TEXT = {
    "model_type": "qwen2",
    "hidden_size": 24,
    "intermediate_size": 40,
    "num_hidden_layers": 3,
    "num_attention_heads": 4,
    "num_key_value_heads": 2,
    "max_position_embeddings": 512,
}
DYNAMIC = {"rope_theta": 1e6, "rope_type": "dynamic", "factor": 2.0}
LANGUAGES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "words": ({"attention_bias": True}, {"rope_parameters": DYNAMIC}),
    "pooled": ({"attention_bias": False, "use_mean_pooling": False}, {"rope_parameters": {"rope_theta": 1e4}}),
}
SMALL = {
    "image_resolution": (28, 28),
    "embed_dim": 24,
    "hidden_dim": 20,
    "state_hidden_dim": 12,
    "num_heads": 4,
    "num_layers": 2,
    "max_state_dim": 7,
    "max_action_dim": evo1s.PADDED,
    "max_text_length": 100,
    "vlm_dtype": "float32",
    "device": "cpu",
}
POLICIES: dict[str, dict[str, Any]] = {
    "words": {"num_inference_timesteps": 4, "n_action_steps": 4, "vlm_num_layers": 2},
    "pooled": {
        "num_inference_timesteps": 3,
        "n_action_steps": 1,
        "vlm_num_layers": None,
        "return_cls_only": True,
        "num_categories": 3,
        "default_embodiment_id": 1,
        "max_views": 2,
        "postprocess_action_dim": 3,
        "normalization_mapping": {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.QUANTILES,
        },
    },
}


@torch.no_grad()
def main() -> None:
    """Both."""
    torch.set_num_threads(1)
    numbers: dict[str, Any] = {}
    shutil.rmtree(evo1s.SAVED, ignore_errors=True)
    for kind in evo1s.KINDS:
        os.chdir(folder := _folder(kind))  # vlm_model_name is a folder here
        language(kind)
        policy = save(kind)
        for call in (0, 1):
            numbers[f"{kind}.{call}"] = chunk(policy, kind, call, evo1s.observation(call))
        policy.config.empty_cameras = 1  # how many may be absent
        given = {key: value for key, value in evo1s.observation(0).items() if key != CAMERAS[0]}
        numbers[f"{kind}.missing"] = chunk(policy, kind, 0, given)
        (folder / "policy" / "model.safetensors").unlink()
        (folder / evo1s.LANGUAGE / "model.safetensors").unlink()
    path = Path(__file__).with_name("lerobot_evo1.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def _folder(kind: str) -> Path:
    folder = evo1s.SAVED / kind
    folder.mkdir(parents=True)
    return folder


def language(kind: str) -> None:
    """The files of a tiny InternVL3; of its tokenizer every byte is a token."""
    vocabulary = {letter: i for i, letter in enumerate(sorted(pre_tokenizers.ByteLevel.alphabet()))}
    made = Tokenizer(models.BPE(vocab=vocabulary, merges=[]))
    made.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    made.add_special_tokens(["<|endoftext|>", "<img>", "</img>", "<IMG_CONTEXT>"])
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=made, pad_token="<|endoftext|>")
    tokenizer.save_pretrained(evo1s.LANGUAGE)
    vision, text = LANGUAGES[kind]
    config = InternVLConfig(
        vision_config=VISION | vision,
        text_config=TEXT | text | {"vocab_size": len(tokenizer)},
        image_token_id=made.get_vocab()["<IMG_CONTEXT>"],
        image_seq_length=4,
    )
    InternVLModel(config).save_pretrained(evo1s.LANGUAGE)


def save(kind: str) -> Any:
    """lerobot's policy, saved by lerobot, with the weights of ``evo1s``."""
    images = {key: PolicyFeature(FeatureType.VISUAL, (3, *evo1s.SIZES[0])) for key in CAMERAS}
    config = Evo1Config(
        **SMALL,
        **POLICIES[kind],
        vlm_model_name=evo1s.LANGUAGE,
        chunk_size=evo1s.HORIZON[kind],
        input_features={STATE: PolicyFeature(FeatureType.STATE, (evo1s.STATE_DIM,)), **images},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (5,))},
    )
    policy = Evo1Policy(config).eval()
    shapes = {name: list(value.shape) for name, value in policy.state_dict().items()}
    policy.load_state_dict(evo1s.weights(shapes))
    statistics = {}
    for key, count in ((STATE, evo1s.STATE_DIM), ("action", 5)):
        low = torch.linspace(-1.5, 0.5, count)
        statistics[key] = {"mean": low, "std": low.abs() + 0.5, "min": low, "max": low + 2, "q01": low, "q99": low + 2}
    policy.save_pretrained("policy")
    for pipeline in make_evo1_pre_post_processors(config, statistics):
        pipeline.save_pretrained("policy")
    Path("policy", evo1s.SHAPES).write_text(json.dumps(shapes))
    return policy


def chunk(policy: Any, kind: str, call: int, given: dict[str, Any]) -> Any:
    """The actions of a whole chunk in robot units."""
    before, after = make_pre_post_processors(policy.config, pretrained_path="policy")
    batch = before({**{key: torch.from_numpy(value) for key, value in given.items()}, "task": evo1s.TASKS[call]})
    drawn = torch.from_numpy((evo1s.noise(kind) + 1) / 2)
    with patch("torch.rand", lambda *shape, **_: drawn.reshape(shape)):
        return after(policy.predict_action_chunk(batch)).numpy()


if __name__ == "__main__":
    main()
