"""A small RDT that sees pictures, the SigLIP that it sees with, and what it is shown; see ``make_rdt``."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors.torch import save_file

from tests.families.checks import Arrays, golden
from tests.families.weights import draw_weights
from ttscompile.frontends.settings import Settings
from ttscompile.policies.networks.siglip import Siglip, SiglipConfig
from ttscompile.policies.rdt import RDTHead, read_config
from ttscompile.policies.rdt_cameras import SIGLIP

from .saved import RDT, save_rdt

SEED, STREAMS, FRAMES, HORIZON, ACTIONS, WORDS = 23, 2, 2, 4, 128, 7
CAMERAS = ("cam_high", "cam_right_wrist", "cam_left_wrist")
VISION: dict[str, Any] = {
    "hidden_size": 32,
    "intermediate_size": 48,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": 78,
    "patch_size": 4,
}
"""19 patches along a side, and two pixels that are in none, as SigLIP's 384 are 27 patches and 6 pixels."""

SIDE, PATCHES = 78, 19**2
GREY = 127
CHANGES: dict[str, Any] = {
    "action_dim": ACTIONS,
    "state_token_dim": ACTIONS,
    "pred_horizon": HORIZON,
    "img_token_dim": VISION["hidden_size"],
    "img_cond_len": FRAMES * len(CAMERAS) * PATCHES,
    "img_pos_embed_config": [["image", [FRAMES, len(CAMERAS), -PATCHES]]],
}
"""Of the small RDT of ``saved``."""


def picture(stream: int, frame: int, camera: str) -> np.ndarray:
    """uint8 ``[H, W, 3]``, as the camera gives it: wide in one stream from the camera above, and else square."""
    size = (52, 96) if stream and camera == "cam_high" else (SIDE, SIDE)
    rng = np.random.default_rng([stream, frame, CAMERAS.index(camera)])
    return rng.integers(0, 256, (*size, 3), dtype=np.uint8)


def squared(given: np.ndarray) -> np.ndarray:
    """uint8 ``[H, W, 3]`` in a square, as docs/howto/vla.md has it: float32 ``[3, side, side]`` of 0..1."""
    height, width = given.shape[:2]
    longest = max(height, width)
    square = Image.new("RGB", (longest, longest), (GREY, GREY, GREY))
    square.paste(Image.fromarray(given), ((longest - width) // 2, (longest - height) // 2))
    seen = np.asarray(square.resize((SIDE, SIDE), Image.Resampling.BICUBIC))
    return np.moveaxis(seen, -1, 0).astype(np.float32) / 255


def shown(stream: int, frame: int, camera: str) -> np.ndarray | None:
    """The same; none of the frame before where the episode begins, as it does in the second stream."""
    return None if stream and not frame else picture(stream, frame, camera)


def observed(*absent: str) -> Arrays:
    """What the policy is given of both streams, without some cameras."""
    grey = np.full((3, SIDE, SIDE), GREY / 255, np.float32)
    found = {key: golden("rdt_pictures")[key] for key in ("lang_tokens", "state_tokens", "action_mask", "ctrl_freqs")}
    lengthened = np.zeros((STREAMS, RDT["max_lang_cond_len"], RDT["lang_token_dim"]), np.float32)
    lengthened[:, :WORDS] = found["lang_tokens"]
    found |= {
        "lang_tokens": lengthened,
        "lang_attn_mask": np.arange(lengthened.shape[1]) < np.full((STREAMS, 1), WORDS),
    }
    for camera in CAMERAS:
        if camera not in absent:
            streams = [[shown(stream, frame, camera) for frame in range(FRAMES)] for stream in range(STREAMS)]
            squares = [[grey if one is None else squared(one) for one in frames] for frames in streams]
            found[camera] = np.array(squares)
    return found


def save(folder: Path, **changes: Any) -> Path:
    """The directory of the policy, in a folder."""
    with torch.device("meta"):
        head = RDTHead(read_config(Settings(RDT | CHANGES, "")))
    shapes = {key: tuple(value.shape) for key, value in head.state_dict().items()}
    return save_rdt(folder / "rdt", draw_weights(shapes, SEED), **(CHANGES | changes))


def save_siglip(folder: Path, alone: bool = False, **changes: Any) -> Path:
    """The whole of a SigLIP, or what sees of it alone, in a folder of its name, whose parent is given."""
    place = folder / SIGLIP
    place.mkdir(parents=True, exist_ok=True)
    vision = VISION | changes
    config = {"model_type": "siglip", "text_config": {"hidden_size": 8}, "vision_config": vision}
    (place / "config.json").write_text(json.dumps({"model_type": "siglip_vision_model"} | vision if alone else config))
    with torch.device("meta"):
        own = {key: tuple(value.shape) for key, value in Siglip(SiglipConfig(**VISION)).state_dict().items()}
    drawn = draw_weights(own, SEED) | {"head.probe": torch.ones(1, 1, 32)}
    others = {"logit_scale": torch.ones(1), "text_model.final_layer_norm.weight": torch.ones(8)}
    named = {f"vision_model.{name}": value for name, value in drawn.items()}
    save_file(drawn if alone else named | others, place / "model.safetensors")
    return folder
