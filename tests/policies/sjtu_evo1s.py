"""Tiny Evo-1 policies as their authors' training saves them, with weights that a seed gives: golden files stay small.

``golden/make_evo1.py`` wrote the folders, and gave their code the same weights, observations and noise.
"""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ttscompile.core.spec import Noise
from ttscompile.core.tokenizer import Tokenizer, padded
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import AS_SAVED, LoadOptions

from . import evo1s
from .vlas import MASK, SHAPES, TOKENS, Array

KINDS = ("bounds", "normal", "quantiles")
"""The second has one action a chunk, two embodiments, and files of the language model as transformers has them."""
TASKS = ("Push the block!", " lift it\n")
SAVED = Path(__file__).parent / "golden" / "evo1"
LANGUAGE = {"bounds": "InternVL3-tiny", "normal": "InternVL3-bare-hf", "quantiles": "InternVL3-bare"}
PADDED, HORIZON = 24, {"bounds": 6, "normal": 1, "quantiles": 5}
STATE_DIM, ACTION_DIM = 5, 4
CAMERAS = ("image_1", "image_2", "image_3")
SIZES: tuple[Any, Any] = (448, {"image_1": [60, 80], "image_2": [896, 896], "image_3": [500, 471]})
"""What ``config.json`` says of the pictures of each call."""
ARM, DATASET = "arm_ee", "blocks"
FILES = {"bounds": "mp_rank_00_model_states.pt", "normal": "checkpoint.pt", "quantiles": "mp_rank_00_model_states.pt"}
ENTRIES = {"mp_rank_00_model_states.pt": "module", "checkpoint.pt": "model_state_dict"}
ZOOMS = (
    ((48, 64), (24, 32)),
    ((48, 64), (24, 33)),
    ((30, 40), (41, 20)),
    ((7, 1), (3, 5)),
    ((1, 90), (1, 31)),
    ((21, 27), (64, 50)),
)
"""Heights and widths before and after, that OpenCV's ``INTER_LINEAR`` is asked for."""
MEANS = (((54, 42), (27, 3)), ((60, 36), (12, 3)))
"""Likewise of ``INTER_AREA``, whole parts of which are no power of two."""


def sizes(call: int) -> dict[str, tuple[int, int]]:
    """Height and width of each camera's pictures."""
    own = SIZES[call]
    return {key: tuple(own[key]) if isinstance(own, dict) else (own, own) for key in CAMERAS}


def save(kind: str, folder: Path, call: int) -> Path:
    """A policy for pictures of this call, and the files of its language model beside it. Gives its directory."""
    shutil.copytree(SAVED / kind, folder, dirs_exist_ok=True)
    shutil.copytree(SAVED / LANGUAGE[kind], folder / LANGUAGE[kind], dirs_exist_ok=True)
    directory, file = folder / "policy", FILES[kind]
    made = weights(json.loads((directory / SHAPES).read_text()))
    (directory / SHAPES).unlink()
    beside = {"ds_version": "0.16.5", "ds_config": {"bf16": {"enabled": True}}, "buffer_names": ["pe"], "step": 3}
    torch.save({**beside, ENTRIES[file]: made}, directory / file)
    path = directory / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"image_size": SIZES[call]}))
    return directory


def statistics(kind: str) -> dict[str, Any]:
    """``norm_stats.json``; some numbers never moved, or nearly so. That of the second kind is an older one."""
    own, other = (_numbers(seed) for seed in (3, 4))
    if kind == "quantiles":
        for part in own.values():
            del part["min"], part["max"]
    if kind == "normal":
        return {ARM: own}
    return {"another_arm": {"x": other}, ARM: {DATASET: own, "others": other}}


def _numbers(seed: int) -> dict[str, Any]:
    rng, found = np.random.RandomState(seed), dict[str, Any]()
    for part, count in (("observation.state", STATE_DIM), ("action", ACTION_DIM)):
        low = rng.uniform(-1.5, -0.3, count)
        high, mean, deviation = low + rng.uniform(1, 2, count), rng.uniform(-1, 1, count), rng.uniform(0.3, 1, count)
        low[-1], high[-2] = high[-1] - 1e-7, low[-2]
        if part == "action":
            deviation[-1] = 1e-7  # of a state it would be all that the network sees
        ends = {"min": low, "max": high, "mean": mean, "std": deviation, "q01": low + 0.1, "q99": high - 0.1}
        ends["q99"][-2:] = ends["q01"][-2:]
        found[part] = {name: value.tolist() for name, value in ends.items()}
    return found


def observation(call: int) -> dict[str, Array]:
    """One frame ``[1, ...]`` of each camera, RGB, and one state, of which some numbers are out of range."""
    rng = np.random.RandomState(call + 11)
    found: dict[str, Array] = {"state": rng.uniform(-2, 2, (1, STATE_DIM)).astype(np.float32)}
    for key, size in sizes(call).items():
        pixels = rng.randint(0, 256, (1, 3, *size))
        found[key] = (pixels / np.float32(255)).astype(np.float32)
    return found


def eager(directory: Path, kind: str, call: int, options: LoadOptions = AS_SAVED) -> Array:
    """The whole chunk of the rebuilt network, not compiled, in robot units."""
    module, spec = load_checkpoint_policy(directory, options=options)
    seen = {key: value[None] for key, value in observation(call).items() if key in spec.observations}
    if spec.instruction is not None:
        length = spec.observations[TOKENS].shape[0]
        own = Tokenizer(directory.parent / LANGUAGE[kind] / "tokenizer.json", CheckpointError)
        tokens = own.of_task(TASKS[call], spec.instruction, length)
        seen[TOKENS], seen[MASK] = padded([tokens], length)
    obs = {key: torch.from_numpy(value) for key, value in seen.items()}
    found: Array = spec.chunk.unnormalized(eager_policy(module, spec)(obs, Noise(noise(kind))).numpy())
    return found


def zooms(pairs: Any) -> list[tuple[tuple[int, int], Array]]:
    """Sizes that OpenCV resizes pictures to, and the pictures."""
    rng = np.random.RandomState(0)
    return [(after, rng.randint(0, 256, (*before, 3)).astype(np.uint8)) for before, after in pairs]


def noise(kind: str) -> Array:
    """``[1, T, D]``, in -1..1; their code draws the same numbers in 0..1."""
    drawn = np.random.RandomState(7).uniform(0, 1, (1, HORIZON[kind], PADDED)).astype(np.float32)
    return drawn * 2 - 1


def weights(shapes: Mapping[str, list[int]]) -> dict[str, torch.Tensor]:
    """By the names and shapes that are saved; those of several embodiments are as large as of one."""
    made = evo1s.weights(dict(shapes))
    return {name: value * (5 if value.ndim == 3 and ".fc" in name else 1) for name, value in made.items()}
