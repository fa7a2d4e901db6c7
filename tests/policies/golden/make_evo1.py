"""Run Evo-1 of its authors at tiny sizes on seeded weights: ``evo1.npz``, and the folder ``evo1``.

Not run by the tests. Needs MINT-SJTU/Evo-1 at 1bf31c4 and OpenGVLab/InternVL at 2410d1d, whose code that of InternVL3
on the hub is, with transformers 4.39.0, OpenCV, torchvision, fvcore and what else they import::

    PYTHONPATH=.:Evo-1/Evo_1:InternVL/internvl_chat python -m tests.policies.golden.make_evo1

The server asks for a graphics card, FlashAttention and bfloat16. Here all is on the processor and in float32, and
attention is torch's own behind FlashAttention's interface: what the mask leaves out is left out, and zeros stand there.
"""

import json
import os
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import torch
from config import EvoConfig
from internvl.model.internvl_chat.configuration_internvl_chat import InternVLChatConfig
from internvl.model.internvl_chat.modeling_internvl_chat import InternVLChatModel
from model.internvl3 import internvl3_embedder
from scripts import Evo1_server as server
from torch.nn.functional import scaled_dot_product_attention
from torch.overrides import TorchFunctionMode
from transformers import PreTrainedModel, Qwen2Config, Qwen2ForCausalLM, Qwen2Tokenizer, Qwen2TokenizerFast
from transformers.models.gpt2.tokenization_gpt2 import bytes_to_unicode
from transformers.models.qwen2 import modeling_qwen2

from .. import sjtu_evo1s as own
from ..vlas import SHAPES, Array

ORGANISATION, SPECIAL = "OpenGVLab", ["<|endoftext|>", "<img>", "</img>", "<IMG_CONTEXT>"]
VISION: dict[str, Any] = {
    "hidden_size": 16,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "intermediate_size": 24,
    "image_size": 448,
    "patch_size": 56,
    "qk_normalization": False,
    "norm_type": "layer_norm",
    "use_flash_attn": False,
    "drop_path_rate": 0.0,
}
TEXT: dict[str, Any] = {
    "architectures": ["Qwen2ForCausalLM"],
    "hidden_size": 24,
    "intermediate_size": 40,
    "num_hidden_layers": 2,
    "num_attention_heads": 4,
    "num_key_value_heads": 2,
    "rope_theta": 1e6,
    "rope_scaling": {"factor": 2.0, "rope_type": "dynamic", "type": "dynamic"},
}
LANGUAGES: dict[str, dict[str, Any]] = {
    "InternVL3-tiny": {"patch_size": 32, "qkv_bias": True},
    "InternVL3-bare": {"qkv_bias": False},
}
MODELS = {"bounds": "InternVL3-tiny", "normal": "InternVL3-bare", "quantiles": "InternVL3-bare"}
POLICIES: dict[str, dict[str, Any]] = {
    "bounds": {"num_inference_timesteps": 4},  # which the server passes over
    "normal": {"num_categories": 2},
    "quantiles": {},
}
MORE: dict[str, dict[str, Any]] = {
    "bounds": {"arm_key": own.ARM, "dataset_key": own.DATASET},
    "normal": {"normalization_type": "normal"},
    "quantiles": {"normalization_type": "bounds_q99", "arm_key": own.ARM, "dataset_key": own.DATASET},
}
"""Entries that users add to what a training writes."""
UNREAD = "vocab.json merges.txt added_tokens.json special_tokens_map.json generation_config.json".split()
MASKS = {"missing": [1, 1, 0], "alone": [1, 0, 0]}


class OnTheProcessor(TorchFunctionMode):
    """Whatever is asked for on a graphics card or in bfloat16."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return function(*map(_plain, args), **{key: _plain(each) for key, each in (kwargs or {}).items()})


def _plain(asked: Any) -> Any:
    """The processor for a graphics card, and float32 for bfloat16."""
    known = {"cuda": "cpu", torch.bfloat16: torch.float32}
    return known.get(asked, asked) if isinstance(asked, (str, torch.dtype)) else asked


@torch.no_grad()
def main() -> None:
    """All kinds."""
    torch.set_num_threads(1)
    shutil.rmtree(own.SAVED, ignore_errors=True)
    own.SAVED.mkdir()
    os.chdir(own.SAVED)
    for name in LANGUAGES:
        language(name)
    numbers: dict[str, Any] = {}
    with patch("torch.nn.Module.to", lambda self, *_, **__: self):
        for kind in own.KINDS:
            with OnTheProcessor():
                model, normalizer = loaded(kind)
                for call in (0, 1):
                    numbers[f"{kind}.{call}"] = chunk(model, normalizer, kind, call, [1, 1, 1])
                for name, mask in MASKS.items():
                    numbers[f"{kind}.{name}"] = chunk(model, normalizer, kind, 0, mask)
            (own.SAVED / kind / "policy" / "mp_rank_00_model_states.pt").unlink()
    as_transformers("InternVL3-bare", "InternVL3-bare-hf")
    for name in LANGUAGES:
        for file in UNREAD:
            (Path(ORGANISATION) / name / file).unlink(missing_ok=True)
        (Path(ORGANISATION) / name).rename(name)
    Path(ORGANISATION).rmdir()
    for what, pairs, way in (("linear", own.ZOOMS, cv2.INTER_LINEAR), ("area", own.MEANS, cv2.INTER_AREA)):
        for number, ((height, width), picture) in enumerate(own.zooms(pairs)):
            made = cv2.resize(picture, (width, height), interpolation=way)
            numbers[f"{what}.{number}"] = made.reshape(height, width, 3)
    path = Path(__file__).with_name("evo1.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def language(name: str) -> None:
    """The files of a tiny InternVL3; of its tokenizer every byte is a token."""
    folder = Path(ORGANISATION) / name
    folder.mkdir(parents=True)
    vocabulary = {letter: i for i, letter in enumerate(bytes_to_unicode().values())}
    (folder / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    files = str(folder / "vocab.json"), str(folder / "merges.txt")
    for kind in (Qwen2TokenizerFast, Qwen2Tokenizer):
        tokenizer = kind(*files)
        tokenizer.add_special_tokens({"additional_special_tokens": SPECIAL[1:]})
        tokenizer.save_pretrained(folder)
    config = InternVLChatConfig(
        VISION | LANGUAGES[name],
        Qwen2Config(**TEXT, vocab_size=len(tokenizer)).to_dict(),
        downsample_ratio=0.5,
        force_image_size=448,
        template="internvl2_5",
        ps_version="v2",
    )
    config.save_pretrained(folder)


def as_transformers(name: str, new: str) -> None:
    """A folder as transformers has the same model."""
    found = json.loads((Path(ORGANISATION) / name / "config.json").read_text())
    vision, ids = found["vision_config"], json.loads((Path(ORGANISATION) / name / "added_tokens.json").read_text())
    same = "hidden_size num_hidden_layers num_attention_heads intermediate_size norm_type layer_norm_eps hidden_act"
    entries: dict[str, Any] = {key: vision[key] for key in same.split()}
    entries |= {key: [vision[key]] * 2 for key in ("image_size", "patch_size")}
    Path(new).mkdir()
    written = {
        "model_type": "internvl",
        "vision_config": entries | {"attention_bias": vision["qkv_bias"], "model_type": "internvl_vision"},
        "text_config": found["llm_config"],
        "image_token_id": ids["<IMG_CONTEXT>"],
        "image_seq_length": 16,
    }
    (Path(new) / "config.json").write_text(json.dumps(written))
    shutil.copy(Path(ORGANISATION) / name / "tokenizer.json", new)


def unfilled(name: str, use_flash_attn: bool, **_: Any) -> Any:
    """The backbone that these files describe, whatever its weights."""
    assert use_flash_attn
    config = InternVLChatConfig.from_pretrained(name)
    config.llm_config._attn_implementation = "flash_attention_2"
    language = Qwen2ForCausalLM(config.llm_config)
    assert type(language.model.layers[0].self_attn) is modeling_qwen2.Qwen2FlashAttention2
    return InternVLChatModel(config, language_model=language, use_flash_attn=False)


def varlen(q: Any, k: Any, v: Any, causal: bool, softmax_scale: Any, **_: Any) -> Any:
    """FlashAttention of one sequence, ``[n, heads, channels]``."""
    assert causal
    q, k, v = (each.transpose(0, 1)[None] for each in (q, k, v))
    return scaled_dot_product_attention(q, k, v, is_causal=True, scale=softmax_scale)[0].transpose(0, 1)


def put_back(x: Any, indices: Any, batch: int, count: int) -> Any:
    """Rows where they were, and zeros."""
    return x.new_zeros(batch * count, *x.shape[1:]).index_copy(0, indices, x).unflatten(0, (batch, count))


FLASH: dict[str, Any] = {
    "flash_attn_varlen_func": varlen,
    "flash_attn_func": None,
    "index_first_axis": lambda x, indices: x[indices],
    "pad_input": put_back,
    "_flash_supports_window_size": True,
}


def loaded(kind: str) -> Any:
    """What the server makes of a directory that a training saved, with the weights of ``sjtu_evo1s``."""
    folder = own.SAVED / kind / "policy"
    folder.mkdir(parents=True)
    config = EvoConfig(
        vlm_name=f"{ORGANISATION}/{MODELS[kind]}",
        horizon=own.HORIZON[kind],
        per_action_dim=own.PADDED,
        state_dim=own.PADDED,
        embed_dim=24,
        hidden_dim=20,
        state_hidden_dim=12,
        num_heads=4,
        num_layers=2,
        dropout=0.2,
        **POLICIES[kind],
    )
    (folder / "config.json").write_text(json.dumps(config.to_dict() | MORE[kind], indent=2))
    (folder / "norm_stats.json").write_text(json.dumps(own.statistics(kind)))
    with (
        patch.object(internvl3_embedder.AutoModel, "from_pretrained", unfilled),
        patch.object(internvl3_embedder, "flash_attn_is_available", lambda: True),
        patch.object(PreTrainedModel, "_autoset_attn_implementation", staticmethod(lambda config, **_: config)),
        patch.multiple(modeling_qwen2, create=True, **FLASH),
    ):
        shapes = {name: list(value.shape) for name, value in server.EVO1(config).state_dict().items()}
        (folder / SHAPES).write_text(json.dumps(shapes))
        torch.save({"module": own.weights(shapes)}, folder / "mp_rank_00_model_states.pt")
        return server.load_model_and_normalizer(str(folder))


def chunk(model: Any, normalizer: Any, kind: str, call: int, mask: list[int]) -> Array:
    """The robot's actions of a whole chunk. A picture that is masked is black, as their clients have it."""
    given, numbers = own.observation(call), own.ACTION_DIM
    pictures = []
    for seen, key in zip(mask, own.CAMERAS, strict=True):
        pixels = np.rint(given[key][0] * 255).astype(np.uint8).transpose(1, 2, 0)
        pictures.append(pixels[..., ::-1] if seen else np.zeros((448, 448, 3), np.uint8))  # the server swaps channels
    asked = {
        "image": pictures,
        "image_mask": mask,
        "state": given["state"][0].tolist(),
        "prompt": own.TASKS[call],
        "action_mask": [1] * numbers + [0] * (own.PADDED - numbers),
    }
    drawn = (torch.from_numpy(own.noise(kind)).flatten(1) + 1) / 2
    with patch("torch.rand", lambda *_, **__: drawn), patch.multiple(modeling_qwen2, create=True, **FLASH):
        made = server.infer_from_json_dict(asked, model, normalizer, own.ARM, own.DATASET)
    return np.array(made, np.float32)[None, :, :numbers]


if __name__ == "__main__":
    main()
