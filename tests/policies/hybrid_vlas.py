"""HybridVLA at a tiny size: what its training saves, with weights that a seed gives.

``tests/families/golden/make_hybrid_vla.py`` gives the original the same.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.families.checks import Arrays, golden
from tests.families.weights import draw_weights
from ttscompile.policies.hybrid_vla import HybridVLAHead, Sizes

SEED, STREAMS = 31, 2
SIZES = Sizes(width=256, hidden=40, layers=2, groups=2, actions=7)
PARTS = ("x_embedder", "t_embedder", "proprio_embedder", "final_layer")

LOW, HIGH = [-0.5, -1.0, 0.0, -2.0, 0.25, 0.5, 0.0], [0.5, 3.0, 0.5, -1.0, 0.25, 1.0, 1.0]
SEEN = {"q01": [0.2, -0.3, 0.7, -3.1, -0.4, -3.1, 0.0], "q99": [0.5, 0.4, 1.5, 3.1, 0.6, 3.1, 1.0]}
MASK = [True, True, True, True, True, True, False]
STATISTICS: dict[str, Any] = {
    "rlbench": {"action": {"q01": LOW, "q99": HIGH, "mask": MASK}, "proprio": SEEN | {"mask": MASK}}
}
CONFIG: dict[str, Any] = {
    "vla": {"vla_id": "hybrid", "base_vlm": "prism-dinosiglip-224px+7b"},
    "future_action_window_size": 0,
    "action_dim": 7,
    "use_diff": True,
    "prefix_tokens": 12,
}

Weights = dict[str, torch.Tensor]


def weights() -> Weights:
    """Those of the language model's layers, and of the parts that diffuse."""
    own = HybridVLAHead(SIZES).state_dict()
    drawn = draw_weights({name: tuple(value.shape) for name, value in own.items()}, SEED)
    for name in ("final_layer.mlp.fc2.weight", "final_layer.mlp.fc2.bias"):
        drawn[name] *= 0.2  # so that actions are not all clipped
    return drawn


def states() -> np.ndarray:
    """The robot's, of which one is beyond what was seen."""
    drawn = np.random.default_rng(SEED + 2).uniform(SEEN["q01"], SEEN["q99"], (STREAMS, 7)).astype(np.float32)
    drawn[0, 2] = 4.0
    return drawn


def scaled(state: np.ndarray) -> np.ndarray:
    """As the original gives it to its network."""
    low, high = np.array(SEEN["q01"]), np.array(SEEN["q99"])
    made = np.where(MASK, 2 * (state - low) / (high - low + 1e-8) - 1, state)
    return np.clip(made, -1, 1).astype(np.float32)


def observation(tokens: int = 12) -> Arrays:
    """What the golden file observes, with padding before it."""
    numbers = golden("hybrid_vla")
    prefix, lengths = numbers["prefix"], numbers["lengths"]
    padded = np.pad(prefix, ((0, 0), (tokens - prefix.shape[1], 0), (0, 0)), constant_values=3.0)
    return {"prefix": padded, "prefix_mask": np.arange(tokens) >= tokens - lengths[:, None], "state": states()}


def save(folder: Path, config: dict[str, Any] | None = CONFIG, statistics: Any = STATISTICS, **parts: Any) -> Path:
    """A run of its training: ``checkpoints``, the configuration and the statistics; a part that is None is left out."""
    (folder / "checkpoints").mkdir(parents=True, exist_ok=True)
    for name, content in (("config.json", config), ("dataset_statistics.json", statistics)):
        (folder / name).unlink(missing_ok=True)
        if content is not None:
            (folder / name).write_text(json.dumps(content))
    drawn = weights()
    named: dict[str, Any] = {
        part: {name.removeprefix(f"{part}."): value for name, value in drawn.items() if name.startswith(f"{part}.")}
        for part in PARTS
    }
    others = {"llm.model.embed_tokens.weight": torch.zeros(3, 256), "llm.lm_head.weight": torch.zeros(3, 256)}
    named["llm_backbone"] = others | {name: value for name, value in drawn.items() if name.startswith("llm.")}
    named |= {
        "vision_backbone": {"dino_featurizer.cls_token": torch.zeros(1, 1, 4)},
        "projector": {"a": torch.zeros(3)},
    }
    for name, change in parts.items():
        named[name] = None if change is None else named[name] | change
        named[name] = named[name] and {key: value for key, value in named[name].items() if value is not None}
    path = folder / "checkpoints" / "step-020792-epoch-01-loss=0.0123.pt"
    torch.save({"model": {name: value for name, value in named.items() if value is not None}}, path)
    return path
