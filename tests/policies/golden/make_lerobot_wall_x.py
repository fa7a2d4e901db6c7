"""Run lerobot's wall_x at tiny sizes on seeded weights: ``lerobot_wall_x.npz``, and the folder of this name.

Not run by the tests. Needs lerobot 0.6.1 with its extra wallx; this repository has to be importable::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_wall_x

lerobot computes in bfloat16 but for norms and the layers of state and actions, whatever a policy says. Here all weights
are float32, and bfloat16 is another name for float32 while actions are computed, since lerobot rounds the token of the
state. Frequencies of rotary positions are no weights: they stay in bfloat16, and with them the angles of the vision
transformer, for what was trained knows no others. Noise is given in place of drawn. Images are resized as on a graphics
card, but with sums in float64, and halves become the higher byte: in float32 the order of a sum decides that.
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
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.wall_x.configuration_wall_x import WallXConfig
from lerobot.policies.wall_x.modeling_wall_x import WallXPolicy
from lerobot.policies.wall_x.processor_wall_x import make_wall_x_pre_post_processors
from lerobot.policies.wall_x.qwen_model import Qwen2_5_VLConfig
from safetensors.torch import load_file, save_file
from torch.nn.functional import interpolate
from transformers import PreTrainedTokenizerFast, Qwen2_5_VLProcessor, Qwen2VLImageProcessor, Qwen2VLVideoProcessor

from .. import groots, wall_xs
from ..vlas import STATE
from .make_lerobot_groot import RESIZE
from .tiny_qwen3_vl import SPECIAL, of_bytes

INTERPOLATE = "torchvision.transforms.v2.functional._geometry.interpolate"
OWN = ["<|propri|>", "<|action|>", "<|action_fast|>"]
VISION: dict[str, dict[str, Any]] = {
    "flow": {
        "depth": 4,
        "hidden_act": "silu",
        "hidden_size": 16,
        "intermediate_size": 20,
        "num_heads": 2,
        "out_hidden_size": 32,
        "patch_size": 14,
        "spatial_merge_size": 2,
        "temporal_patch_size": 2,
        "tokens_per_second": 2,
        "window_size": 112,
        "fullatt_block_indexes": [1, 3],
    },
    "nested": {
        "depth": 3,
        "hidden_size": 24,
        "intermediate_size": 28,
        "num_heads": 3,
        "out_hidden_size": 24,
        "patch_size": 21,
        "window_size": 126,
        "fullatt_block_indexes": [0],
    },
}
TEXT: dict[str, dict[str, Any]] = {
    "flow": {
        "hidden_act": "silu",
        "hidden_size": 32,
        "intermediate_size": 44,
        "num_hidden_layers": 3,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "rms_norm_eps": 1e-6,
        "rope_theta": 1e6,
        "rope_scaling": {"type": "mrope", "mrope_section": [1, 1, 2]},
        "num_experts": 2,
        "experts": [
            {"hidden_size": 32, "intermediate_size": 44, "hidden_act": "silu"},
            {"hidden_size": 32, "intermediate_size": 20, "hidden_act": "silu"},
        ],
        "dim_inputs": [32, 32],
        "attention_moe": False,
        "mlp_moe": True,
        "dof_config": {"arm": 4, "gripper": 1, "spare": 2},
    },
    "nested": {
        "hidden_size": 24,
        "intermediate_size": 36,
        "num_hidden_layers": 4,
        "num_attention_heads": 2,
        "num_key_value_heads": 1,
        "rms_norm_eps": 1e-5,
        "rope_parameters": {"rope_type": "default", "rope_theta": 1e4, "mrope_section": [3, 2, 1]},
        "num_experts": 3,
        "experts": [
            {"hidden_size": 24, "intermediate_size": 36, "hidden_act": "silu"},
            {"hidden_size": 12, "intermediate_size": 16, "hidden_act": "silu"},
            {"hidden_size": 24, "intermediate_size": 8, "hidden_act": "silu"},
        ],
        "dim_inputs": [24, 12, 24],
        "mlp_moe": True,
        "dof_config": {"arm": 4},
    },
}
PLACES = {"flow": {"arm": 4, "gripper": 1, "spare": 1}, "nested": {"arm": 3}}
"""Numbers of a state."""
IMAGES: dict[str, dict[str, Any]] = {
    "flow": {"min_pixels": 56 * 56, "max_pixels": 16384 * 28 * 28},
    "nested": {
        "patch_size": 21,
        "size": {"shortest_edge": 3136, "longest_edge": 40000},
        "image_mean": [0.5, 0.4, 0.3],
        "image_std": [0.5, 0.6, 0.7],
    },
}
POLICIES: dict[str, dict[str, Any]] = {
    "flow": {"n_action_steps": 4, "max_state_dim": 6, "max_action_dim": 7},
    "nested": {
        "n_action_steps": wall_xs.HORIZON["nested"],
        "max_state_dim": 3,
        "max_action_dim": 4,
        "vision_attn_implementation": "sdpa",
        "normalization_mapping": {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.QUANTILES,
            "ACTION": NormalizationMode.MIN_MAX,
        },
    },
}


@torch.no_grad()
def main() -> None:
    """Both."""
    torch.set_num_threads(1)
    numbers: dict[str, Any] = {}
    shutil.rmtree(wall_xs.SAVED, ignore_errors=True)
    for kind in wall_xs.KINDS:
        folder = wall_xs.SAVED / kind
        folder.mkdir(parents=True)
        os.chdir(folder)
        base(kind)
        policy = save(kind)
        for call in (0, 1):
            numbers[f"{kind}.{call}"] = chunk(policy, kind, call, wall_xs.observation(kind, call))
        absent = wall_xs.CAMERAS[kind][wall_xs.MISSING[kind]]
        given = {key: value for key, value in wall_xs.observation(kind, 0).items() if key != absent}
        numbers[f"{kind}.missing"] = chunk(policy, kind, 0, given)
        (folder / "policy" / "model.safetensors").unlink()
        (folder / wall_xs.BASE / "model.safetensors").unlink()
    path = Path(__file__).with_name("lerobot_wall_x.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def base(kind: str) -> None:
    """What lerobot reads of the model that a policy was trained from; of its tokenizer every byte is a token."""
    made = of_bytes()
    made.add_special_tokens(OWN)
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=made, pad_token=SPECIAL[0])
    pictures, ids = Qwen2VLImageProcessor(**IMAGES[kind]), made.get_vocab()
    entries: dict[str, Any] = {
        "vision_config": VISION[kind],
        "agent_pos_config": PLACES[kind],
        "image_token_id": ids["<|image_pad|>"],
        "video_token_id": ids["<|video_pad|>"],
        "vision_start_token_id": ids["<|vision_start|>"],
        "vision_end_token_id": ids["<|vision_end|>"],
    }
    folder = Path(wall_xs.BASE)
    if kind == "flow":
        pictures.save_pretrained(folder)
        tokenizer.save_pretrained(folder)
        entries |= TEXT[kind] | {"model_type": "qwen2_5_vl", "vocab_size": len(tokenizer) + 5}
        (folder / "config.json").write_text(json.dumps(entries, indent=1))
    else:
        Qwen2_5_VLProcessor(pictures, tokenizer, Qwen2VLVideoProcessor()).save_pretrained(folder)
        text = TEXT[kind] | {"vocab_size": len(tokenizer), "pad_token_id": ids[SPECIAL[0]]}
        Qwen2_5_VLConfig(text_config=text, tie_word_embeddings=True, **entries).save_pretrained(folder)
    save_file({}, folder / "model.safetensors")


def save(kind: str) -> Any:
    """lerobot's policy, saved by lerobot, with the weights of ``wall_xs``."""
    sizes = zip(wall_xs.CAMERAS[kind], wall_xs.SIZES[kind][0], strict=True)
    places, actions = wall_xs.STATE_DIM[kind], wall_xs.ACTION_DIM[kind]
    config = WallXConfig(
        **POLICIES[kind],
        pretrained_name_or_path=f"./{wall_xs.BASE}",
        chunk_size=wall_xs.HORIZON[kind],
        device="cpu",
        input_features={
            STATE: PolicyFeature(FeatureType.STATE, (places,)),
            **{key: PolicyFeature(FeatureType.VISUAL, (3, *size)) for key, size in sizes},
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (actions,))},
    )
    policy = WallXPolicy(config).eval()
    for weight in policy.parameters():
        weight.data = weight.data.float()
    policy.save_pretrained("policy")
    shapes = {name: list(value.shape) for name, value in load_file("policy/model.safetensors").items()}
    loaded = policy.load_state_dict(wall_xs.weights(shapes), strict=False)
    assert not loaded.unexpected_keys, loaded
    assert loaded.missing_keys in ([], ["model.model.embed_tokens.weight"]), loaded  # tied
    statistics: dict[str, dict[str, torch.Tensor]] = {}
    for key, count in ((STATE, places), ("action", actions)):
        low = torch.linspace(-1.5, 0.5, count)
        statistics[key] = {"mean": low, "std": low.abs() + 0.5, "min": low, "max": low + 2, "q01": low, "q99": low + 2}
    for pipeline in make_wall_x_pre_post_processors(config, statistics):
        pipeline.save_pretrained("policy")
    Path("policy", groots.SHAPES).write_text(json.dumps(shapes))
    return policy


def chunk(policy: Any, kind: str, call: int, given: dict[str, Any]) -> Any:
    """The actions of a whole chunk in robot units."""
    before, after = make_pre_post_processors(policy.config, pretrained_path="policy")
    batch = before({**{key: torch.from_numpy(value) for key, value in given.items()}, "task": wall_xs.TASKS[call]})
    drawn = torch.from_numpy(wall_xs.noise(kind))
    with (
        patch("torch.bfloat16", torch.float32),
        patch(RESIZE, lambda _: False),
        patch(INTERPOLATE, summed),
        patch("torch.randn", lambda *_, **__: drawn),
    ):
        return after(policy.predict_action_chunk(batch)).numpy()


def summed(image: torch.Tensor, size: tuple[int, int], **how: Any) -> torch.Tensor:
    """torch's own resize by its own weights, in float64; what is a half is a little more."""
    sides = zip(image.shape[-2:], size, strict=True)
    units = ((torch.eye(old)[None, None], (new, old)) for old, new in sides)
    rows, columns = (interpolate(unit, each, **how)[0, 0].double() for unit, each in units)
    return rows @ image.double() @ columns.T + 1e-6


if __name__ == "__main__":
    main()
