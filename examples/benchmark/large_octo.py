"""Octo-small 1.5 at its real size with random weights, for ``large.py``: two frames of two cameras, and T5-base."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import numpy.typing as npt
import torch
from large_smolvla import random_weight, write_json
from torch import nn

from ttscompile.policies.networks.octo_network import MASK, PADDING, TOKENS, Head, Octo, OctoConfig, Stem
from ttscompile.policies.networks.t5 import Words
from ttscompile.policies.octo import CHECKPOINT, CONFIG, EXAMPLE
from ttscompile.policies.quantiles import STATISTICS

WINDOW, LENGTH, ACTIONS = 2, 16, 7
CAMERAS = {"primary": 256, "wrist": 128}
"""Side of a picture."""
FEATURES, PATCH = (32, 96, 192, 384), 16
"""Of ``SmallStem16``: channels of its four convolutions, and pixels of a token's side."""
_ARRAY = 1
"""flax's extension of msgpack for an array."""


def config() -> OctoConfig:
    """The sizes of ``octo-small-1.5``."""
    stems = {
        name: Stem(
            keys=(f"image_{name}",),
            kind="SmallStem16",
            channels=(3, 3),
            features=FEATURES,
            layers=((3, 2, 1),) * len(FEATURES),
            patch=PATCH // 2 ** len(FEATURES),
            out=512,
            imagenet=False,
            tokens=(side // PATCH) ** 2,
        )
        for name, side in CAMERAS.items()
    }
    return OctoConfig(
        width=384,
        hidden=1536,
        layers=12,
        heads=6,
        window=WINDOW,
        longest=10,
        words=Words("language", LENGTH, 32128, 768, 3072, 12, 12, 768, 32),
        head=Head(horizon=4, actions=ACTIONS, width=256, waves=32, blocks=3, steps=20, bound=5.0),
        readout=("action", 1),
        stems=stems,
        repeated=True,
        right=True,
    )


def save(directory: Path) -> None:
    """What Octo's ``save_pretrained`` writes."""
    own = config()
    moments = {"mean": [0.01] * ACTIONS, "std": [0.1] * ACTIONS}
    folder = directory / "300000" / "default"
    folder.mkdir(parents=True)
    write_json(directory / CONFIG, entries(own))
    write_json(directory / STATISTICS, {"bridge_dataset": {"action": moments}})
    (directory / EXAMPLE).write_bytes(packed(example()))
    with torch.device("meta"):
        network = Octo(own)
    (folder / CHECKPOINT).write_bytes(packed(drawn(network)))


def entries(own: OctoConfig) -> dict[str, Any]:
    """``config.json`` of a network."""

    def part(kind: str, **kwargs: Any) -> dict[str, Any]:
        return {"module": "octo", "name": kind, "args": [], "kwargs": kwargs}

    cameras = {}
    for name, stem in own.stems.items():
        encoder = part(stem.kind, features=stem.features, num_features=stem.out)
        cameras[name] = part("ImageTokenizer", obs_stack_keys=stem.keys, task_stack_keys=stem.keys, encoder=encoder)
    sizes = {"action_horizon": own.head.horizon, "action_dim": own.head.actions, "hidden_dim": own.head.width}
    return {
        "window_size": own.window,
        "model": {
            "observation_tokenizers": cameras,
            "task_tokenizers": {"language": part("LanguageTokenizer", encoder="t5-base")},
            "heads": {"action": part("DiffusionActionHead", readout_key="readout_action", use_map=False, **sizes)},
            "readouts": dict([own.readout]),
            "token_embedding_size": own.width,
            "transformer_kwargs": {
                "num_layers": own.layers,
                "mlp_dim": own.hidden,
                "num_attention_heads": own.heads,
                "add_position_embedding": False,
            },
            "max_horizon": own.longest,
            "repeat_task_tokens": own.repeated,
            "use_correct_attention": own.right,
        },
        "text_processor": part("HFTokenizer", tokenizer_name="t5-base", encode_with_model=False),
    }


def example() -> dict[str, Any]:
    """Shapes of what the training was shown."""
    images = {f"image_{name}": np.zeros((1, WINDOW, side, side, 3), np.uint8) for name, side in CAMERAS.items()}
    words = {name.rpartition(".")[2]: np.zeros((1, LENGTH), np.int64) for name in (TOKENS, MASK)}
    return {
        "observation": {**images, PADDING: np.ones((1, WINDOW), bool)},
        "task": {**{key: value[:, 0] for key, value in images.items()}, "language_instruction": words},
    }


def drawn(network: nn.Module) -> dict[str, Any]:
    """Random weights as flax has them: by the names of its modules, kernels with outputs last."""
    draw, tree = torch.Generator().manual_seed(0), dict[str, Any]()
    for name, value in network.state_dict().items():
        path, _, kind = name.rpartition(".")
        array = random_weight(name, value.shape, draw).numpy()
        embedding = isinstance(network.get_submodule(path), nn.Embedding)
        if kind == "weight" and embedding:
            kind = "embedding"
        elif kind == "weight" and array.ndim > 1:
            kind, array = "kernel", array.transpose(*((1, 0) if array.ndim == 2 else (2, 3, 1, 0)))
        elif kind == "weight":
            kind = "scale"
        place = tree
        for module in path.split("."):
            place = place.setdefault(module, {})
        place[kind] = array
    return tree


def packed(tree: dict[str, Any]) -> bytes:
    """As flax writes it."""

    def array(value: npt.NDArray[Any]) -> msgpack.ExtType:
        return msgpack.ExtType(_ARRAY, msgpack.packb([value.shape, value.dtype.name, value.tobytes()]))

    content: bytes = msgpack.packb(tree, default=array)
    return content
