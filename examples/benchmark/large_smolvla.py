"""SmolVLA at its real size with random weights, for ``large.py``: the checkpoint, and one call of it in its parts."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from torch import nn

from ttscompile import Noise, PolicySpec
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import AS_SAVED
from ttscompile.frontends.settings import Settings
from ttscompile.policies.lerobot.smolvla import RELEASED, read_config
from ttscompile.policies.lerobot.vla import read_vla_config
from ttscompile.policies.networks.smolvla import SmolVLA
from ttscompile.runtimes.random_calls import random_calls

MODEL = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
STATE, CAMERAS, ACTION = "observation.state", ("observation.images.front", "observation.images.wrist"), "action"

FEATURES = {
    STATE: {"type": "STATE", "shape": [6]},
    **{key: {"type": "VISUAL", "shape": [3, 480, 640]} for key in CAMERAS},
    ACTION: {"type": "ACTION", "shape": [6]},
}
_SIZES = {
    "chunk_size": 50,
    "num_steps": 10,
    "max_state_dim": 32,
    "max_action_dim": 32,
    "tokenizer_max_length": 48,
    "num_vlm_layers": 16,
    "self_attn_every_n_layers": 2,
    "expert_width_multiplier": 0.75,
    "min_period": 4e-3,
    "max_period": 4.0,
}
"""Lerobot's own, which a saved configuration has, and other programs read."""
_MODES = {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}


def save(directory: Path) -> None:
    """What lerobot's ``save_pretrained`` writes of a SmolVLA with its default configuration."""
    directory.mkdir(parents=True, exist_ok=True)
    entries = {
        "type": "smolvla",
        "input_features": {key: each for key, each in FEATURES.items() if key != ACTION},
        "output_features": {ACTION: FEATURES[ACTION]},
        "vlm_model_name": MODEL,
        **_SIZES,
    }
    write_json(directory / "config.json", entries)
    write_processors(directory)
    config = read_config(read_vla_config(directory, entries, AS_SAVED), Settings(RELEASED[MODEL], f"{MODEL}: "))
    with torch.device("meta"):
        shapes = SmolVLA(config).state_dict()
    draw = torch.Generator().manual_seed(0)
    weights = {f"model.{name}": random_weight(name, value.shape, draw) for name, value in shapes.items()}
    # As in released checkpoints: embeddings in bf16, and a norm that no action depends on.
    weights[f"{_TEXT}.embed_tokens.weight"] = weights[f"{_TEXT}.embed_tokens.weight"].bfloat16()
    weights[f"{_TEXT}.norm.weight"] = torch.ones_like(weights[f"{_TEXT}.layers.0.input_layernorm.weight"])
    save_file(weights, directory / "model.safetensors")


def write_processors(directory: Path, features: Mapping[str, Any] = FEATURES) -> None:
    """Normalisers that change nothing."""
    numbers = {"mean": 0.0, "std": 1.0}
    statistics = {f"{key}.{n}": torch.full((6,), value) for key in (STATE, ACTION) for n, value in numbers.items()}
    save_file(statistics, directory / "statistics.safetensors")
    own = {"config": {"eps": 1e-8, "features": features, "norm_map": _MODES}, "state_file": "statistics.safetensors"}
    for name, kind in (("pre", "normalizer_processor"), ("post", "unnormalizer_processor")):
        write_json(directory / f"policy_{name}processor.json", {"steps": [{"registry_name": kind, **own}]})


_TEXT = "model.vlm_with_expert.vlm.model.text_model"


def random_weight(name: str, shape: torch.Size, draw: torch.Generator) -> torch.Tensor:
    """Such that the numbers in the network neither vanish nor explode."""
    if len(shape) > 1:  # GR00T's, of all embodiments, are [kinds, before, after]
        read = shape[1] if name.endswith(".W") else shape[1:].numel()
        return torch.randn(shape, generator=draw) * read**-0.5
    return torch.ones(shape) if name.endswith("weight") else torch.zeros(shape)  # a norm's, whatever it is called


def save_drawn(path: Path, shapes: Mapping[str, torch.Size], halved: str | tuple[str, ...] = ()) -> None:
    """Write random weights one after the other, so that they need no memory that a machine may not have.

    Args:
        halved: how names begin of those that are in bf16.
    """
    header, end = dict[str, Any](), 0
    half = {name: name.startswith(halved) for name in shapes}
    for name, shape in shapes.items():
        start, end = end, end + (2 if half[name] else 4) * shape.numel()
        header[name] = {"dtype": "BF16" if half[name] else "F32", "shape": list(shape), "data_offsets": [start, end]}
    content, draw = json.dumps(header).encode(), torch.Generator().manual_seed(0)
    content += b" " * (-len(content) % 8)
    with path.open("wb") as file:
        file.write(len(content).to_bytes(8, "little") + content)
        for name, shape in shapes.items():
            value = random_weight(name, shape, draw)
            (value.bfloat16().view(torch.int16) if half[name] else value).numpy().tofile(file)


def write_json(path: Path, content: Any) -> None:
    """A file of a checkpoint."""
    path.write_text(json.dumps(content), encoding="utf-8")


def call(spec: PolicySpec) -> tuple[dict[str, np.ndarray], Noise]:
    """One observation, and the noise of a call."""
    return random_calls(spec, 1, seed=0)[0]


def eager(
    module: nn.Module, vision: nn.Module, spec: PolicySpec, clock: Callable[[], float] = process_time
) -> Callable[[], tuple[np.ndarray, list[float]]]:
    """A call in eager PyTorch: the actions; and the seconds, by ``clock``, of image encoder, prefix and loop."""
    obs, noise = call(spec)
    given = {key: torch.from_numpy(value) for key, value in obs.items()}
    whole: Any = module
    run, took = eager_policy(module, spec), dict[nn.Module, float]()
    for part in (vision, whole.encoder):
        part.register_forward_pre_hook(lambda one, _: took.update({one: took.get(one, 0.0) - clock()}))
        part.register_forward_hook(lambda one, _, __: took.update({one: took[one] + clock()}))

    def timed() -> tuple[np.ndarray, list[float]]:
        took.clear()
        start = clock()
        sample = run(given, noise).numpy()
        whole_call, seen, prefix = clock() - start, took[vision], took[whole.encoder]
        actions = spec.chunk.unnormalized(sample)[:, spec.chunk.start : spec.chunk.stop]
        return actions, [seen, prefix - seen, whole_call - prefix]

    return timed
