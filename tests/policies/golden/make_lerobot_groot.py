"""Run lerobot's groot at tiny sizes on seeded weights: ``lerobot_groot.npz``, and the folder ``lerobot_groot``.

Not run by the tests. Needs lerobot 0.6.1 with transformers, diffusers and dm-tree; this repository has to be
importable::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_groot
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
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.groot import GrootConfig, GrootPolicy, make_groot_pre_post_processors
from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config
from safetensors.torch import load_file
from transformers import Qwen2VLImageProcessor, Qwen3VLConfig

from .. import groots
from ..vlas import CAMERAS, STATE, Array
from . import tiny_qwen3_vl as tiny

BACKBONE = f"./nvidia/{groots.BACKBONE}"
"""Where lerobot looks for a tokenizer, whatever the base model says."""
RESIZE = "torchvision.transforms.v2.functional._geometry._do_native_uint8_resize_on_cpu"
BACKBONES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "words": (
        {"deepstack_visual_indexes": [0, 2]},
        {"rope_parameters": {"rope_type": "default", "rope_theta": 5e6, "mrope_section": [2, 2, 2]}},
    ),
    "native": (
        {"deepstack_visual_indexes": [2, 0], "num_heads": 4},
        {"rope_parameters": {"rope_type": "default", "rope_theta": 1e4, "mrope_section": [4, 1, 1]}},
    ),
}
DIT = {
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
MIXING = {
    "positional_embeddings": None,
    "num_layers": 1,
    "num_attention_heads": 3,
    "attention_head_dim": 8,
    "dropout": 0.2,
    "final_dropout": True,
}
BASES: dict[str, dict[str, Any]] = {
    "words": {"diffusion_model_cfg": DIT, "vl_self_attention_cfg": MIXING, "select_layer": 3},
    "native": {
        "diffusion_model_cfg": DIT | {"num_layers": 3, "interleave_self_attention": False},
        "vl_self_attention_cfg": None,
        "select_layer": 2,
        "use_alternate_vl_dit": False,
        "use_vlln": False,
        "add_pos_embed": False,
        "num_inference_timesteps": 3,
    },
}
GROUPS = {"arm": [-1.5, -0.5, 0.0], "gripper": [0.5]}
"""Groups of the second policy's state and where each begins to be usual; of its actions the first has one more."""
PROCESSORS: dict[str, dict[str, Any]] = {
    "words": {"image_target_size": [24, 24], "image_crop_size": [20, 20]},
    "native": {
        "image_target_size": [16, 16],
        "shortest_image_edge": 28,
        "crop_fraction": 0.9,
        "formalize_language": False,
        "use_percentiles": True,
        "max_action_horizon": groots.HORIZON,
        "modality_configs": {
            "arm": {
                "state": {"modality_keys": list(GROUPS), "delta_indices": [0]},
                "action": {
                    "modality_keys": list(GROUPS),
                    "delta_indices": list(range(groots.HORIZON - 1)),
                    "action_configs": [{"rep": "ABSOLUTE", "type": "NON_EEF", "format": "DEFAULT"}] * 2,
                },
                "video": {"modality_keys": ["wrist", "front"], "delta_indices": [-1, 0]},
            }
        },
    },
}
POLICIES: dict[str, dict[str, Any]] = {
    "words": {"n_action_steps": 4},
    "native": {"embodiment_tag": "arm", "n_action_steps": groots.HORIZON},
}


@torch.no_grad()
def main() -> None:
    """Both."""
    torch.set_num_threads(1)
    numbers: dict[str, Any] = {}
    shutil.rmtree(groots.SAVED, ignore_errors=True)
    for kind in groots.KINDS:
        folder = groots.SAVED / kind
        folder.mkdir(parents=True)
        os.chdir(folder)
        backbone(kind)
        base(kind)
        policy = save(kind)
        for call in (0, 1):
            numbers[f"{kind}.{call}"] = chunk(policy, call, groots.observation(call))
        given = {key: value for key, value in groots.observation(0).items() if key != CAMERAS[0]}
        numbers[f"{kind}.missing"] = chunk(policy, 0, given)
        shutil.copytree("policy", "plain")
        if kind == "words":  # the other one's actions do not look at its state
            groots.without_clipping(folder / "policy")
            numbers[f"{kind}.far"] = chunk(policy, 0, groots.far())
            shutil.copy(Path("plain", "policy_preprocessor.json"), "policy")
        groots.with_liberos_rule(folder / "policy")
        policy.config.action_decode_transform = "libero"
        numbers[f"{kind}.libero"] = chunk(policy, 0, groots.observation(0))
        shutil.rmtree("policy")
        Path("plain").rename("policy")
        (folder / "policy" / "model.safetensors").unlink()
        (folder / groots.BASE / "model.safetensors").unlink()
        Path(BACKBONE, "video_preprocessor_config.json").unlink()
        Path(BACKBONE).rename(groots.BACKBONE)
        Path("nvidia").rmdir()
    path = Path(__file__).with_name("lerobot_groot.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def backbone(kind: str) -> None:
    """The files of a tiny Qwen3-VL; of its tokenizer every byte is a token."""
    ids, (vision, text) = tiny.save_processor(Path(BACKBONE), Qwen2VLImageProcessor), BACKBONES[kind]
    config = Qwen3VLConfig(
        vision_config=tiny.VISION | vision,
        text_config=tiny.TEXT | text | {"vocab_size": len(ids), "pad_token_id": None},
        **tiny.tokens_of(ids),
        tie_word_embeddings=True,
    )
    config.save_pretrained(BACKBONE)


def base(kind: str) -> None:
    """A base model, with what lerobot reads beside it."""
    config = GR00TN17Config(
        model_name=BACKBONE,
        model_dtype="float32",
        dtype="float32",
        backbone_embedding_dim=24,
        hidden_size=18,
        input_embedding_dim=20,
        max_state_dim=groots.STATE_PADDED,
        max_action_dim=groots.PADDED,
        action_horizon=groots.HORIZON,
        max_seq_len=9,
        max_num_embodiments=11 if kind == "words" else 3,
        **BASES[kind],
    )
    GR00TN17(config, load_backbone_weights=False).float().save_pretrained(groots.BASE)
    folder = Path(groots.BASE)
    (folder / "processor_config.json").write_text(json.dumps({"processor_kwargs": PROCESSORS[kind]}, indent=1))
    if kind == "native":
        statistics: dict[str, Any] = {"state": {}, "action": {}}
        for part in statistics:
            for key, low in GROUPS.items():
                own = np.array(low + [0.25] * (part == "action" and key == "arm"))
                spread = {"min": own - 9, "max": own + 9, "mean": own, "std": own * 0 + 1}
                spread |= {"q01": own, "q99": own + 2}
                statistics[part][key] = {name: value.tolist() for name, value in spread.items()}
        (folder / "statistics.json").write_text(json.dumps({"arm": statistics}, indent=1))
        (folder / "embodiment_id.json").write_text(json.dumps({"arm": 2, "leg": 0}))


def save(kind: str) -> Any:
    """lerobot's policy, saved by lerobot, with the weights of ``groots``."""
    images = {key: PolicyFeature(FeatureType.VISUAL, (3, *groots.SIZES[0])) for key in CAMERAS}
    config = GrootConfig(
        **POLICIES[kind],
        base_model_path=f"./{groots.BASE}",
        chunk_size=groots.HORIZON,
        max_state_dim=groots.STATE_PADDED,
        max_action_dim=groots.PADDED,
        use_bf16=False,
        device="cpu",
        input_features={STATE: PolicyFeature(FeatureType.STATE, (groots.STATE_DIM,)), **images},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (groots.ACTION_DIM,))},
    )
    policy = GrootPolicy(config).eval()
    policy.save_pretrained("policy")
    shapes = {name: list(value.shape) for name, value in load_file("policy/model.safetensors").items()}
    loaded = policy.load_state_dict(groots.weights(shapes), strict=False)
    assert not loaded.unexpected_keys, loaded
    assert loaded.missing_keys == ["_groot_model.backbone.model.model.language_model.embed_tokens.weight"]  # tied
    statistics: dict[str, dict[str, torch.Tensor]] = {}
    for key, count in ((STATE, groots.STATE_DIM), ("action", groots.ACTION_DIM)):
        low = torch.linspace(-1.5, 0.5, count)
        statistics[key] = {"mean": low, "std": low.abs() + 0.5, "min": low, "max": low + 2}
    statistics[STATE]["max"][1] = statistics[STATE]["min"][1]  # of a joint that never moved
    for pipeline in make_groot_pre_post_processors(config, statistics):
        pipeline.save_pretrained("policy")
    Path("policy", groots.SHAPES).write_text(json.dumps(shapes))
    return policy


def chunk(policy: Any, call: int, given: dict[str, Any], noise: Array | None = None) -> Any:
    """The actions of a whole chunk in robot units."""
    drawn = torch.from_numpy(groots.noise() if noise is None else noise)
    before, after = make_pre_post_processors(policy.config, pretrained_path="policy")
    batch = {**{key: torch.from_numpy(value) for key, value in given.items()}, "task": groots.TASKS[call]}
    # As on a graphics card: on a processor torchvision would round in the middle of a resize.
    with patch(RESIZE, lambda _: False):
        batch = before(batch)
    with patch("torch.randn", lambda *_, **__: drawn):
        return after(policy.predict_action_chunk(batch)).numpy()


if __name__ == "__main__":
    main()
