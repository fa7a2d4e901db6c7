"""Run lerobot's xvla at tiny sizes on seeded weights: ``lerobot_xvla.npz``, and the folder ``lerobot_xvla``.

Not run by the tests. Needs lerobot 0.6.1 with transformers; this repository has to be importable::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_xvla
"""

import json
import os
import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.xvla.configuration_xvla import XVLAConfig
from lerobot.policies.xvla.modeling_xvla import XVLAPolicy
from lerobot.policies.xvla.processor_xvla import make_xvla_pre_post_processors
from safetensors.torch import load_file, save_file
from tokenizers import AddedToken, Tokenizer, models, pre_tokenizers, processors
from transformers import PreTrainedTokenizerFast

from .. import xvlas
from ..vlas import CAMERAS, STATE

VISION = {
    "depths": [1, 1, 2],
    "patch_size": [7, 3, 3],
    "patch_stride": [4, 2, 2],
    "patch_padding": [3, 1, 1],
    "patch_prenorm": [False, True, True],
    "embed_dim": [8, 12, 16],
    "num_heads": [2, 3, 4],
    "num_groups": [2, 2, 4],
    "window_size": 3,
    "projection_dim": 24,
    "max_position_embeddings": 6,
    "max_temporal_embeddings": 4,
}
EARLIER = (
    (r"(vision_tower\.convs\.\d+)\.conv\.", r"\1.proj."),
    (r"\.(conv[12])\.(weight|bias)$", r".\1.fn.dw.\2"),
    (r"\.(window|channel)_attn\.", r".\1_attn.fn."),
    (r"\.(spatial|channel)_block\.ffn\.", r".\1_block.ffn.fn.net."),
    (r"\.spatial_block\.norm1\.", ".spatial_block.window_attn.norm."),
    (r"\.channel_block\.norm1\.", ".channel_block.channel_attn.norm."),
    (r"_block\.norm2\.", "_block.ffn.norm."),
    (r"\.multi_modal_projector\.image_position_embed\.", ".image_pos_embed."),
    (r"\.multi_modal_projector\.visual_temporal_embed\.", ".visual_temporal_embed."),
    (r"\.multi_modal_projector\.", "."),
    (r"\.language_model\.", ".language_model.model."),
)
"""How the code that Microsoft published with Florence-2 calls its weights."""
TEXT = {
    "d_model": 24,
    "encoder_layers": 2,
    "encoder_attention_heads": 3,
    "encoder_ffn_dim": 32,
    "decoder_layers": 1,
    "decoder_attention_heads": 2,
    "decoder_ffn_dim": 16,
    "max_position_embeddings": 60,
}
SMALL = {
    "hidden_size": 32,
    "depth": 2,
    "num_heads": 4,
    "mlp_ratio": 2.0,
    "num_domains": 3,
    "len_soft_prompts": 4,
    "dim_time": 6,
    "max_len_seq": 96,
    "tokenizer_name": xvlas.LANGUAGE,
    "tokenizer_max_length": 24,
    "device": "cpu",
}
NORMALISED = {
    "VISUAL": NormalizationMode.IDENTITY,
    "STATE": NormalizationMode.MEAN_STD,
    "ACTION": NormalizationMode.MEAN_STD,
}
POLICIES: dict[str, dict[str, Any]] = {
    "ee6d": {
        "num_denoising_steps": 4,
        "n_action_steps": 3,
        "resize_imgs_with_padding": (32, 32),
        "empty_cameras": 1,
        "normalization_mapping": NORMALISED,
    },
    "auto": {
        "action_mode": "auto",
        "max_action_dim": xvlas.ACTIONS["auto"],
        "max_state_dim": 5,
        "num_denoising_steps": 3,
        "n_action_steps": 5,
        "use_hetero_proj": True,
        "dim_time": 7,
        "pad_language_to": "longest",
    },
    "so101": {
        "action_mode": "so101_bimanual",
        "max_state_dim": 20,
        "num_denoising_steps": 2,
        "n_action_steps": 5,
        "len_soft_prompts": 0,
        "num_image_views": 2,
        "tokenizer_padding_side": "left",
    },
}
KEPT = {"ee6d": 20, "auto": 6, "so101": 12}
DOMAINS = {"ee6d": 2, "auto": 1, "so101": 0}


@torch.no_grad()
def main() -> None:
    """All."""
    torch.set_num_threads(1)
    numbers: dict[str, Any] = {}
    shutil.rmtree(xvlas.SAVED, ignore_errors=True)
    xvlas.SAVED.mkdir()
    os.chdir(xvlas.SAVED)  # tokenizer_name is a folder here
    words = tokenizer()
    for kind in xvlas.KINDS:
        save(kind, words)
        policy = XVLAPolicy.from_pretrained(kind)
        for call in (0, 1):
            numbers[f"{kind}.{call}"] = chunk(policy, kind, kind, call, xvlas.observation(call, kind))
        given = {key: value for key, value in xvlas.observation(0, kind).items() if key != CAMERAS[0]}
        numbers[f"{kind}.missing"] = chunk(policy, kind, kind, 0, given)
        Path(kind, "model.safetensors").unlink()
    for mode in xvlas.MODES:
        with TemporaryDirectory() as folder:
            directory = xvlas.save(mode, Path(folder))
            policy, given = XVLAPolicy.from_pretrained(directory), xvlas.observation(0, mode)
            numbers[mode] = chunk(policy, str(directory), mode, 0, given)
    with TemporaryDirectory() as folder:
        directory = xvlas.save("ee6d", Path(folder))
        xvlas.normalise(directory, [CAMERAS[1]])
        policy, given = XVLAPolicy.from_pretrained(directory), xvlas.observation(1)
        numbers["ee6d.one"] = chunk(policy, str(directory), "ee6d", 0, given)
    path = Path(__file__).with_name("lerobot_xvla.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def tokenizer() -> int:
    """The files of a tiny tokenizer like BART's, of which every byte is a token. Returns how many there are."""
    special = ["<s>", "<pad>", "</s>"]
    letters = special + sorted(pre_tokenizers.ByteLevel.alphabet())
    made = Tokenizer(models.BPE(vocab={letter: i for i, letter in enumerate(letters)}, merges=[]))
    made.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    made.add_special_tokens([AddedToken(each, special=True) for each in special])
    made.post_processor = processors.RobertaProcessing(("</s>", 2), ("<s>", 0), add_prefix_space=False)
    names = {"bos_token": "<s>", "pad_token": "<pad>", "eos_token": "</s>"}
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=made, **names)
    tokenizer.save_pretrained(xvlas.LANGUAGE)
    path = Path(xvlas.LANGUAGE, "config.json")
    path.write_text(json.dumps({"model_type": "bart"}))
    return len(tokenizer)


def florence(kind: str, words: int) -> dict[str, Any]:
    """The entries of a tiny Florence-2; in one kind as Microsoft's code writes them."""
    text = TEXT | {"vocab_size": words}
    if kind != "auto":
        return {"vision_config": VISION, "text_config": {"model_type": "bart", **text}}
    vision = {
        "dim_embed" if name == "embed_dim" else name: value
        for name, value in VISION.items()
        if not name.startswith("max_")
    }
    vision |= {
        "model_type": "davit",
        "qkv_bias": False,
        "image_feature_source": ["spatial_avg_pool", "temporal_avg_pool"],
    }
    vision["image_pos_embed"] = {"type": "learned_abs_2d", "max_pos_embeddings": 6}
    vision["visual_temporal_embedding"] = {"type": "COSINE", "max_temporal_embeddings": 4}
    return {
        "vision_config": vision,
        "text_config": {"model_type": "florence2_language", "scale_embedding": True, **text},
    }


def save(kind: str, words: int) -> None:
    """lerobot's policy, saved by lerobot, with the weights of ``xvlas``."""
    images = {key: PolicyFeature(FeatureType.VISUAL, (3, *xvlas.SIZES[0])) for key in CAMERAS}
    config = XVLAConfig(
        **SMALL | POLICIES[kind],
        florence_config=florence(kind, words),
        chunk_size=xvlas.HORIZON,
        input_features={STATE: PolicyFeature(FeatureType.STATE, (xvlas.STATE_DIM,)), **images},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (KEPT[kind],))},
    )
    statistics = {}
    for key, count in ((STATE, xvlas.STATE_DIM), ("action", KEPT[kind])):
        low = torch.linspace(-1.5, 0.5, count)
        statistics[key] = {"mean": low, "std": low.abs() + 0.5}
    XVLAPolicy(config).save_pretrained(kind)
    for pipeline in make_xvla_pre_post_processors(config, statistics):
        pipeline.save_pretrained(kind)
    path = Path(kind, "policy_preprocessor.json")
    steps = json.loads(path.read_text())
    for step in steps["steps"]:
        if step["registry_name"] == "xvla_add_domain_id":
            step["config"]["domain_id"] = DOMAINS[kind]
    if kind == "so101":  # pictures as they are
        steps["steps"] = [step for step in steps["steps"] if not step["registry_name"].startswith("xvla_image")]
    path.write_text(json.dumps(steps, indent=2))
    file = Path(kind, "model.safetensors")
    if kind == "auto":
        save_file(earlier(load_file(file)), file)
    shapes = {name: list(value.shape) for name, value in load_file(file).items()}
    save_file(xvlas.weights(shapes), file)
    Path(kind, xvlas.SHAPES).write_text(json.dumps(shapes))


def earlier(weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights under the names that lerobot gave them before it used transformers' Florence-2; it reads both."""
    found = {"model.vlm.language_model.final_logits_bias": torch.zeros(1, 4)}
    for name, value in weights.items():
        for pattern, old in EARLIER:
            name = re.sub(pattern, old, name)
        if name == "model.vlm.image_projection.weight":
            name, value = "model.vlm.image_projection", value.T.contiguous()
        found[name] = value
    return found


def chunk(policy: Any, directory: str, kind: str, call: int, given: dict[str, Any]) -> Any:
    """The actions of a whole chunk in robot units."""
    before, after = make_pre_post_processors(policy.config, pretrained_path=directory)
    batch = before({**{key: torch.from_numpy(value) for key, value in given.items()}, "task": xvlas.TASKS[call]})
    with patch("torch.randn", lambda *shape, **_: torch.from_numpy(xvlas.noise(kind)).reshape(shape)):
        return after(policy.predict_action_chunk(batch)).numpy()


if __name__ == "__main__":
    main()
