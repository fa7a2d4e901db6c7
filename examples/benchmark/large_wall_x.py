"""Wall-X at its real size with random weights, for ``large.py``: the checkpoint, and the files of its base."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from large_eo1 import MODEL as QWEN
from large_evo1 import save_letters
from large_smolvla import ACTION, CAMERAS, FEATURES, STATE, save_drawn, write_json, write_processors

from ttscompile.frontends.families import AS_SAVED
from ttscompile.frontends.settings import Settings, read_json
from ttscompile.policies.lerobot.processors import SENTENCE
from ttscompile.policies.lerobot.qwen25_vl import DEVIATION, MEAN, read_qwen25
from ttscompile.policies.lerobot.vla import read_vla_config
from ttscompile.policies.networks.wall_x import WallX, WallXConfig

BASE = "wall-oss-flow"
_TOKENS = 151936
_MARKS = {"<|endoftext|>": 151643, "<|im_start|>": 151644, "<|im_end|>": 151645, "<|vision_start|>": 151652}
_MARKS |= {"<|vision_end|>": 151653, "<|image_pad|>": 151655, "<|propri|>": 151665, "<|action|>": 151666}
EXPERT = 2048
"""Width inside the feed-forward layers of actions, which is an assumption: the released configuration could not be had
here. Those of words and pictures are Qwen's."""
_PADDED, _HORIZON = 20, 32
"""Numbers of a state and of an action, and actions of a chunk: lerobot's own."""
_SAVED = (
    (r"^backbone\.visual\.", "visual."),
    (r"^backbone\.language_model\.(layers\.\d+)\.mlp\.", r"model.\1.moe.experts.0."),
    (r"^backbone\.language_model\.", "model."),
    (r"^experts\.(\d+)\.", r"model.layers.\1.moe.experts.1."),
    (r"^(propri_proj|w1|w2|w3|action_proj_back)\.", r"action_preprocessor.\1."),
)


def model() -> dict[str, Any]:
    """What the base's ``config.json`` has."""
    text: dict[str, Any] = QWEN["text_config"]
    width, sizes = text["hidden_size"], (text["intermediate_size"], EXPERT)
    experts = [{"hidden_size": width, "hidden_act": "silu", "intermediate_size": each} for each in sizes]
    own = {"mlp_moe": True, "num_experts": 2, "dim_inputs": [width, width], "experts": experts}
    return {**QWEN, "text_config": {**text, **own}}


def save(directory: Path) -> None:
    """What lerobot's ``save_pretrained`` writes of a wall_x with its default configuration, most in bf16."""
    base = directory.parent / BASE
    for each in (directory, base):
        each.mkdir(parents=True, exist_ok=True)
    write_json(base / "config.json", model())
    colours = {"image_mean": list(MEAN), "image_std": list(DEVIATION), "patch_size": 14, "merge_size": 2}
    write_json(base / "preprocessor_config.json", colours)
    save_letters(base, _MARKS, _TOKENS)
    entries = {
        "type": "wall_x",
        "input_features": {key: FEATURES[key] for key in (STATE, *CAMERAS)},
        "output_features": {ACTION: FEATURES[ACTION]},
        "pretrained_name_or_path": f"x-square-robot/{BASE}",
        "chunk_size": _HORIZON,
        "n_action_steps": _HORIZON,
        "max_state_dim": _PADDED,
        "max_action_dim": _PADDED,
    }
    write_json(directory / "config.json", entries)
    write_processors(directory)
    path = directory / "policy_preprocessor.json"
    write_json(path, {"steps": [{"registry_name": SENTENCE, "config": {}}, *read_json(path)["steps"]]})
    shared, language = read_vla_config(directory, entries, AS_SAVED), read_qwen25(Settings(model(), ""))
    expert = replace(language.text, hidden=EXPERT)
    config = WallXConfig(language, expert, shared.state_dim, _PADDED, shared.action_dim, _PADDED)
    with torch.device("meta"):
        shapes = {f"model.{_saved(name)}": each.shape for name, each in WallX(config, ()).state_dict().items()}
    save_drawn(directory / "model.safetensors", shapes, halved=("model.model.", "model.visual."))


def _saved(name: str) -> str:
    """What lerobot calls a weight."""
    return next(found for old, new in _SAVED if (found := re.sub(old, new, name)) != name)
