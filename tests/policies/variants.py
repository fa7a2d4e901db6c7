"""The variants of Diffusion Policy's network, and the types of the fixtures that build and save a checkpoint of one."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

Build = Callable[..., dict[str, Any]]
Save = Callable[[dict[str, Any]], Path]

VARIANTS: list[tuple[str, bool, dict[str, Any]]] = [
    ("token-wise condition encoder", True, {}),
    ("token-wise condition encoder", True, {"causal_attn": False, "n_layer": 2, "n_emb": 24, "n_head": 3}),
    ("token-wise condition encoder", True, {"causal_attn": False, "n_obs_steps": None}),
    ("transformer condition encoder", True, {"n_cond_layers": 2}),
    ("inpainting", False, {}),
    ("inpainting", False, {"n_cond_layers": 1, "causal_attn": False}),
    ("encoder-only", False, {"time_as_cond": False}),
    ("encoder-only", False, {"time_as_cond": False, "causal_attn": False}),
]
