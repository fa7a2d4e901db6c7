"""Run NVIDIA's GR00T N1.7 at tiny sizes on seeded weights: ``groot.npz``, and the folder ``groot``.

Not run by the tests. Needs NVIDIA/Isaac-GR00T at 65cc4a1 with transformers 4.57.3, diffusers, albumentations 1.4.18 and
OpenCV 4.12; it and this repository have to be importable::

    PYTHONPATH=.:Isaac-GR00T python -m tests.policies.golden.make_groot

Its attention is torch's own (sdpa) in place of FlashAttention's, and all is in float32 in place of bfloat16. Its later
code pads pictures only where ``letter_box_transform`` says so; of the policy ``still`` that step is taken out.
"""

import json
import os
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import patch

import albumentations
import cv2
import gr00t.model  # noqa: F401
import numpy as np
import torch
from gr00t.configs.model.gr00t_n1d7 import Gr00tN1d7Config
from gr00t.model.gr00t_n1d7.gr00t_n1d7 import Gr00tN1d7
from gr00t.model.gr00t_n1d7.processing_gr00t_n1d7 import Gr00tN1d7Processor
from gr00t.policy import gr00t_policy
from safetensors import safe_open
from transformers import Qwen2VLImageProcessorFast, Qwen3VLConfig, Qwen3VLForConditionalGeneration

from .. import isaac_groots as own
from ..vlas import SHAPES, Array
from . import tiny_qwen3_vl as tiny

NAME = f"nvidia/{own.BACKBONE}"
DIT: dict[str, Any] = {
    "positional_embeddings": None,
    "num_layers": 4,
    "num_attention_heads": 2,
    "attention_head_dim": 10,
    "norm_type": "ada_norm",
    "dropout": 0.2,
    "final_dropout": True,
    "output_dim": 18,
    "interleave_self_attention": True,
}
MIXING: dict[str, Any] = {
    "positional_embeddings": None,
    "num_layers": 1,
    "num_attention_heads": 3,
    "attention_head_dim": 8,
    "dropout": 0.2,
    "final_dropout": True,
}
MODELS: dict[str, dict[str, Any]] = {
    "droid": {"vl_self_attention_cfg": MIXING, "select_layer": 3},
    "arm": {"select_layer": 3, "use_alternate_vl_dit": False, "use_vlln": False, "num_inference_timesteps": 3},
    "still": {"select_layer": 3, "add_pos_embed": False},
}
RELATIVE = {
    "eef_9d": {"rep": "RELATIVE", "type": "EEF", "format": "XYZ_ROT6D", "state_key": "eef_9d"},
    "joints": {"rep": "RELATIVE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None},
}
ABSOLUTE = {"rep": "ABSOLUTE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}
PROCESSORS: dict[str, dict[str, Any]] = {
    "droid": {
        "use_albumentations": True,
        "shortest_image_edge": 32,
        "crop_fraction": 0.95,
        "use_percentiles": True,
        "use_relative_action": True,
    },
    "arm": {
        "image_target_size": [24, 24],
        "image_crop_size": [20, 20],
        "formalize_language": False,
        "apply_sincos_state_encoding": True,
        "letter_box_transform": True,
    },
    "still": {
        "use_albumentations": True,
        "shortest_image_edge": None,
        "image_target_size": [24, 24],
        "crop_fraction": None,
        "image_crop_size": [21, 21],
        "clip_outliers": False,
    },
}
STATE_KEYS: dict[str, dict[str, Any]] = {
    "droid": {},
    "arm": {"sin_cos_embedding_keys": ["waist", "arm"], "mean_std_embedding_keys": ["hand"]},
    "still": {"mean_std_embedding_keys": []},
}
ACTION_KEYS: dict[str, dict[str, Any]] = {
    "droid": {"action_configs": [RELATIVE["eef_9d"], ABSOLUTE, RELATIVE["joints"]]},
    "arm": {"mean_std_embedding_keys": ["arm", "hand"]},
    "still": {},
}


@torch.no_grad()
def main() -> None:
    """All kinds."""
    torch.set_num_threads(1)
    shutil.rmtree(own.SAVED, ignore_errors=True)
    own.SAVED.mkdir()
    os.chdir(own.SAVED)
    backbone()
    numbers: dict[str, Any] = {}
    for kind in own.KINDS:
        folder = own.SAVED / kind / "policy"
        save(kind, folder)
        with patch.object(Qwen3VLForConditionalGeneration, "from_pretrained", unfilled):
            policy = loaded(kind, folder)
        for call in (0, 1):
            numbers[f"{kind}.{call}"] = chunk(policy, kind, call)
        for file in folder.glob("*.safetensors*"):
            file.unlink()
    Path(NAME, "video_preprocessor_config.json").unlink()
    Path(NAME).rename(own.BACKBONE)
    Path("nvidia").rmdir()
    for number, ((height, width), picture) in enumerate(own.zooms()):
        numbers[f"zoom.{number}"] = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    path = Path(__file__).with_name("groot.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def backbone() -> None:
    """The files of a tiny Qwen3-VL; of its tokenizer every byte is a token."""
    ids = tiny.save_processor(Path(NAME), Qwen2VLImageProcessorFast)
    turned = {"rope_type": "default", "mrope_section": [2, 2, 2], "mrope_interleaved": True}
    Qwen3VLConfig(
        vision_config=tiny.VISION | {"deepstack_visual_indexes": [0, 2]},
        text_config=tiny.TEXT | {"vocab_size": len(ids), "rope_theta": 5e6, "rope_scaling": turned},
        **tiny.tokens_of(ids),
        tie_word_embeddings=True,
    ).save_pretrained(NAME)


def unfilled(name: str, **_: Any) -> Any:
    """The backbone that these files describe, whatever its weights."""
    return Qwen3VLForConditionalGeneration._from_config(Qwen3VLConfig.from_pretrained(name), attn_implementation="sdpa")


def save(kind: str, folder: Path) -> None:
    """What a training saves, without its weights: their names and shapes."""
    config = Gr00tN1d7Config(
        architectures=["Gr00tN1d7"],
        model_name=NAME,
        model_dtype="float32",
        backbone_embedding_dim=24,
        hidden_size=18,
        input_embedding_dim=20,
        max_state_dim=own.PADDED_STATE,
        max_action_dim=own.PADDED,
        action_horizon=own.HORIZON,
        max_seq_len=9,
        max_num_embodiments=4,
        diffusion_model_cfg=DIT,
        use_flash_attention=False,
        **MODELS[kind],
    )
    with patch.object(Qwen3VLForConditionalGeneration, "from_pretrained", unfilled):
        Gr00tN1d7(config, {}).float().save_pretrained(folder)
    shapes: dict[str, list[int]] = {}
    for file in sorted(folder.glob("*.safetensors")):
        with safe_open(file, "pt") as opened:
            shapes |= {name: list(opened.get_slice(name).get_shape()) for name in opened.keys()}  # noqa: SIM118
    (folder / SHAPES).write_text(json.dumps(shapes))
    frames = {"delta_indices": own.FRAMES[kind], "modality_keys": list(own.CAMERAS[kind])}
    modality: dict[str, Any] = {
        "video": frames,
        "state": {"delta_indices": [0], "modality_keys": list(own.STATES[kind]), **STATE_KEYS[kind]},
        "action": {
            "delta_indices": list(range(own.STEPS[kind])),
            "modality_keys": list(own.ACTIONS[kind]),
            **ACTION_KEYS[kind],
        },
        "language": {"delta_indices": [0], "modality_keys": ["task"]},
    }
    tag = own.TAGS[kind]
    processor = Gr00tN1d7Processor(
        {tag: modality, **({"xdof_relative_eef_relative_joint": modality} if kind == "arm" else {})},
        statistics={tag: own.statistics(kind)},
        model_name=NAME,
        max_state_dim=own.PADDED_STATE,
        max_action_dim=own.PADDED,
        max_action_horizon=own.HORIZON,
        embodiment_id_mapping={tag: own.NUMBERS[kind]},
        transformers_loading_kwargs={},
        **PROCESSORS[kind],
    )
    processor.save_pretrained(folder)


def loaded(kind: str, folder: Path) -> Any:
    """Its policy, in float32, with the weights of ``isaac_groots``."""
    with patch("torch.bfloat16", torch.float32):
        policy = gr00t_policy.Gr00tPolicy(own.TAGS[kind], str(folder), device="cpu")
    found = policy.model.load_state_dict(own.weights(json.loads((folder / SHAPES).read_text())), strict=False)
    assert not found.unexpected_keys, found
    assert all(name.endswith("lm_head.weight") for name in found.missing_keys), found
    policy.model.float()
    if kind == "still":
        transforms = policy.processor.eval_image_transform.transforms
        del transforms[0]
        for step in (0, 2):  # as its later code resizes where it does not keep proportions
            transforms[step] = albumentations.Resize(24, 24, interpolation=cv2.INTER_AREA)
    return policy


def chunk(policy: Any, kind: str, call: int) -> Array:
    """The actions of a whole chunk in robot units, of all groups in their order."""
    given, at, state = own.observation(kind, call), 0, {}
    for name, count in own.STATES[kind].items():
        state[name] = given["state"][None, :, at : at + count]
        at += count
    video = {
        key: np.rint(given[f"video.{key}"] * 255).astype(np.uint8).transpose(0, 2, 3, 1)[None]
        for key in own.CAMERAS[kind]
    }
    drawn = torch.from_numpy(own.noise())
    asked = {"video": video, "state": state, "language": {"task": [[own.TASKS[call]]]}}
    with patch("torch.randn", lambda *_, **__: drawn), patch("torch.bfloat16", torch.float32):
        actions, _ = policy.get_action(asked)
    return np.concatenate([actions[name] for name in own.ACTIONS[kind]], -1)


if __name__ == "__main__":
    main()
