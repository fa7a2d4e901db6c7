"""Tiny pi0 and pi0.5 policies as openpi saves them, with weights that a seed gives, so that golden files stay small.

``golden/make_openpi.py`` gives openpi the same folders, observations and noise.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

from tests.word_tokenizer import write_tokenizer
from ttscompile.core.spec import Noise
from ttscompile.core.tokenizer import Tokenizer, padded
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import AS_SAVED, LoadOptions
from ttscompile.policies.networks.pi import Pi, PiConfig

from . import pis
from .hybrid import fill
from .lerobot_tiny import write_json
from .vlas import Array, as_given

KINDS = ("pi0", "pi05", "plain")
"""The last is a pi0.5 that is told no state, as openpi's ``pi05_libero`` is."""
TEXT, EXPERT, VISION = pis.TEXT, pis.EXPERT, replace(pis.VISION, image_size=224)
STATE_DIM, ACTION_DIM, PADDED, HORIZON, LENGTH = 4, 5, 7, 6, 16
CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
ABSENT = CAMERAS[2]
SIZES = ((224, 224), (180, 300))
"""Height and width of the images of each call; openpi resizes the second's."""
TASKS = ("Push_the block", " pick up\nthe cup ")
WORDS: tuple[str, ...] = (
    "?",
    "Task:",
    "Push",
    "the",
    "block,",
    "block",
    "State:",
    "Action:",
    "\n",
    "pick",
    "up",
    "cup",
    "cup,",
    ";",
)
WORDS += tuple(f"{n}{end}" for n in (-1, 0, 127, 128, 255, *range(10, 14)) for end in ("", ";"))
"""Of the tokenizer; every other one is the first."""
VOCABULARY = 50
SET = "somebody/arm"


def config(kind: str) -> PiConfig:
    """Sizes of a policy."""
    state = PADDED if kind == "pi0" else None
    return PiConfig(VISION, TEXT, VOCABULARY, EXPERT, state, PADDED, (4e-3, 4.0))


def weights(kind: str) -> dict[str, torch.Tensor]:
    """Under the names of openpi's ``PI0Pytorch``, the embedding under that of the head, as safetensors saves both."""
    drawn = fill(dict(Pi(config(kind)).state_dict()), 3)
    found = {name: value * (0.6 if value.ndim > 1 else 1) for name, value in drawn.items()}
    renamed = {name.replace(".vision_tower.", ".vision_tower.vision_model."): value for name, value in found.items()}
    embedding = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
    renamed["paligemma_with_expert.paligemma.lm_head.weight"] = renamed.pop(embedding)
    return renamed


def save(kind: str, directory: Path, **entries: Any) -> Path:
    """Save a policy as openpi's converter to PyTorch does. Returns the directory.

    Args:
        entries: of ``config.json`` beside those of the converter, or others; None leaves one out.
    """
    directory.mkdir(parents=True)
    said = {"action_dim": PADDED, "action_horizon": HORIZON, "paligemma_variant": "gemma_2b", "max_token_len": LENGTH}
    said |= {"action_expert_variant": "gemma_300m", "precision": "float32"}
    said |= {"discrete_state_input": kind == "pi05"} if kind != "pi0" else {}
    write_json(directory / "config.json", {key: each for key, each in {**said, **entries}.items() if each is not None})
    save_file(weights(kind), directory / "model.safetensors")
    save_statistics(directory)
    return directory


def statistics() -> dict[str, dict[str, list[float]]]:
    """As ``norm_stats.json`` has them; the second number of the state never moved."""
    found = {}
    for part, count in (("state", STATE_DIM), ("actions", ACTION_DIM)):
        low = np.linspace(-1.53, 0.47, count)
        own = {"mean": low + 0.1, "std": np.abs(low) + 0.5, "q01": low, "q99": low + 2}
        if part == "state":
            own["std"][1], own["q99"][1] = 0, own["q01"][1]
        found[part] = {name: value.tolist() for name, value in own.items()}
    return found


def save_statistics(directory: Path, name: str = SET, **parts: Any) -> Path:
    """Those of a data set, or others. Returns the file."""
    path = directory / "assets" / name / "norm_stats.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"norm_stats": {**statistics(), **parts}})
    return path


def pictures(call: int) -> dict[str, Array]:
    """The cameras' bytes ``[H, W, 3]``: noise, and a ramp, so that smoothing matters and a shift does, too."""
    rng, (height, width) = np.random.RandomState(call), SIZES[call]
    ramp = np.linspace(0, 160, width)[None, :, None]
    return {key: (ramp + rng.uniform(0, 95, (height, width, 3))).astype(np.uint8) for key in CAMERAS}


def state(call: int) -> Array:
    """``[D]``, near the middle of the ranges; the number that never moved is where it was."""
    moved = np.random.RandomState(100 + call).uniform(-1, 1, STATE_DIM).astype(np.float32)
    moved[1] = np.float32(statistics()["state"]["mean" if call else "q01"][1])
    return moved


def states() -> Array:
    """``[N, D]``, of robots whose state is anywhere: far outside, at edges of ranges, and between."""
    drawn = np.random.RandomState(7).standard_normal((20, STATE_DIM)).astype(np.float32)
    drawn[:10] *= 4
    drawn[5:15, 1] = np.float32(statistics()["state"]["q01"][1])
    ends = [statistics()["state"][name] for name in ("q01", "q99")]
    return np.concatenate([drawn, np.array(ends, np.float32)])


def noise() -> Array:
    """``[1, T, D]``."""
    return np.random.RandomState(11).standard_normal((1, HORIZON, PADDED)).astype(np.float32)


def observed(call: int) -> dict[str, Array]:
    """One frame of one stream as the compiled policy takes it, ``[1, ...]``, and its task as text is not among it."""
    images = {key: np.moveaxis(each, -1, 0)[None] / np.float32(255) for key, each in pictures(call).items()}
    return {**images, "state": state(call)[None]}


def save_tokenizer(folder: Path) -> Path:
    """One of words, as PaliGemma's folder would have it. Returns the folder around it."""
    own = write_tokenizer(folder / "paligemma-3b-pt-224", {word: n for n, word in enumerate(WORDS)})
    write_json(own / "config.json", {"model_type": "paligemma"})
    return folder


def eager(directory: Path, words: Path, call: int, options: LoadOptions = AS_SAVED) -> Array:
    """The whole chunk of the rebuilt network, not compiled; told its task with the tokenizer in a folder."""
    module, spec = load_checkpoint_policy(directory, options=options)
    given, told = observed(call), spec.instruction
    if told is not None:
        in_words = "" if told.state is None else told.state(state(call))
        own = Tokenizer(words / "paligemma-3b-pt-224", CheckpointError)
        given[told.tokens], given[told.mask] = padded([own.of_task(TASKS[call], told, LENGTH, in_words)], LENGTH)
    obs = {key: torch.from_numpy(as_given(key, given, spec)) for key in spec.observations}
    return spec.chunk.unnormalized(eager_policy(module, spec)(obs, Noise(noise())).numpy())


def assert_same(found: Array, expected: Array) -> None:
    """Within a ten-thousandth of the range of the actions; openpi's are padded."""
    expected = expected[..., :ACTION_DIM]
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() < 1e-4 * np.ptp(expected)
