"""A policy beside vla.cpp (github.com/VinRobotics/vla.cpp), the same weights and the same call, taking turns.

    python examples/benchmark/large.py --smolvla --output DIR        # or --pi0, --pi05, --groot, --evo1, --vla-jepa
    python examples/benchmark/vla_cpp.py DIR --library libvla.so --model smolvla.gguf [--threads 1]

``DIR`` is what ``large.py`` leaves. ``libvla.so`` is vla.cpp's own: build it with its CMakeLists, which takes ggml from
llama.cpp. A ggml that is built by itself leaves ``GGML_LLAMAFILE`` off, and is slower. ``smolvla.gguf`` is what its
``convert_smolvla_to_gguf.py`` makes of ``DIR/smolvla``, and so for pi0, VLA-JEPA and pi0.5, which wants
``--dataset-stats DIR/pi05/stats.json``, too. GR00T's and Evo-1's read the names of a release, of which
``released_groot.py`` and ``released_evo1.py`` write the weights.

vla.cpp is given tokens, and pictures that are resized beforehand. See ``beside.py`` for what is timed.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import click
import numpy as np
import numpy.typing as npt
import torch
from beside import Array, observed, policy_of, race, race_options
from large import saved
from large_evo1 import MODEL
from large_groot import EMBODIMENT
from large_qwen3_vl import IMAGE_TOKEN
from large_smolvla import CAMERAS, STATE

from ttscompile import Noise
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions

FLOATS = 1
"""Of vla.cpp's interface (``vla.h``): pixels are floats from 0 to 1."""

STATES = 256
"""Numbers of a state, of which each policy reads as many as it is padded to."""


class Image(ctypes.Structure):
    """``vla_image``."""

    _fields_: ClassVar = [
        ("data", ctypes.c_void_p),
        ("w", ctypes.c_int32),
        ("h", ctypes.c_int32),
        ("format", ctypes.c_int32),
    ]


class Inputs(ctypes.Structure):
    """``vla_inputs``."""

    _fields_: ClassVar = [
        ("images", ctypes.POINTER(Image)),
        ("n_images", ctypes.c_int32),
        ("precomputed_img_emb", ctypes.c_void_p),
        ("n_img_views", ctypes.c_int32),
        ("lang_tokens", ctypes.c_void_p),
        ("n_lang", ctypes.c_int32),
        ("state", ctypes.c_void_p),
        ("noise", ctypes.c_void_p),
        ("attention_mask", ctypes.c_void_p),
        ("attention_mask_n", ctypes.c_int32),
        ("timing_detail", ctypes.c_int32),
    ]


class Stats(ctypes.Structure):
    """``vla_stats``, milliseconds."""

    _fields_: ClassVar = [(name, ctypes.c_float) for name in ("total", "vision", "inference", "prefill", "denoise")]


IMAGE_TOKENS = {"groot": IMAGE_TOKEN, "vla_jepa": IMAGE_TOKEN, "evo1": MODEL["image_token_id"]}
"""Of policies whose prompt says where pictures stand."""


@dataclass(frozen=True)
class Prompt:
    """What vla.cpp leaves to its caller.

    Attributes:
        tokens: int32 ``[L]``, of pictures too where the policy says where they stand.
        seen: a picture ``[3, S, S]`` in 0..1 as the network reads it, of the same size.
    """

    tokens: npt.NDArray[np.int32]
    seen: Callable[[Array], Array]


def prompt_of(folder: Path, name: str, obs: Mapping[str, Array]) -> Prompt:
    """The prompt of a policy that ``large.py`` saved."""
    if name not in IMAGE_TOKENS:
        (tokens,) = (np.ascontiguousarray(obs[key].reshape(-1), np.int32) for key in obs if key.endswith("tokens"))
        return Prompt(tokens, lambda each: each)
    directory, task = saved(folder, name)
    encoder: Any = load_checkpoint_policy(directory, options=LoadOptions(task=task))[0].encoder
    prefix, found = encoder.prefix, list[int]()
    network = prefix.embedder if name == "evo1" else prefix.backbone
    between = network.prompt.between
    count = network.config.image_tokens if name == "evo1" else network.pictured.count(True) // len(between)
    for words in between:
        found += [*words, *[IMAGE_TOKENS[name]] * count]
    tokens = np.array([*found, *encoder.task[0].tolist(), *network.prompt.later], np.int32)
    if name == "evo1":
        return Prompt(tokens, lambda each: each)
    zoom, cameras = prefix.seen, network.prompt.images  # without the network, which takes memory

    def seen(each: Array) -> Array:
        made = zoom([torch.from_numpy(each)[None] * 2 - 1] * cameras)
        return np.asarray((made[0][0] + 1) / 2)

    return Prompt(tokens, seen)


class VlaCpp:
    """vla.cpp with a model; see ``beside.Rival``.

    Args:
        library: ``libvla.so``.
        model: the GGUF file.
        threads: of its arithmetic.
        prompt: of the policy.
    """

    parts = "pictures, the rest"

    def __init__(self, library: Path, model: Path, threads: int, prompt: Prompt) -> None:
        os.environ |= {"VLA_N_THREADS": str(threads), "VLA_GR00T_EMBODIMENT": str(EMBODIMENT)}
        self._library, self._prompt = ctypes.CDLL(str(library.absolute())), prompt
        self._library.vla_model_load.restype = ctypes.c_void_p
        self._model = ctypes.c_void_p(self._library.vla_model_load(None, str(model).encode(), None))
        if not self._model:
            raise SystemExit(f"{model}: vla.cpp cannot load it.")

    def predict(self, obs: Mapping[str, Array], noise: Noise) -> tuple[Array, list[float]]:
        """The actions ``[T, D]``, of all channels; and seconds, of both pictures and of all the rest."""
        rows = [self._prompt.seen(obs[key][0, 0]).transpose(1, 2, 0).astype(np.float32, order="C") for key in CAMERAS]
        images = (Image * len(rows))(*(Image(each.ctypes.data, *each.shape[:2], FLOATS) for each in rows))
        numbers, initial = np.zeros(STATES, np.float32), np.ascontiguousarray(noise.initial[0])
        if STATE in obs:
            numbers[: obs[STATE].size] = obs[STATE].reshape(-1)
        given = Inputs(
            images,
            len(rows),
            lang_tokens=self._prompt.tokens.ctypes.data,
            n_lang=self._prompt.tokens.size,
            state=numbers.ctypes.data,
            noise=initial.ctypes.data,
        )
        found, count, stats = ctypes.POINTER(ctypes.c_float)(), ctypes.c_int64(), Stats()
        status = self._library.vla_predict(self._model, ctypes.byref(given), ctypes.byref(found), ctypes.byref(count))
        if status:
            raise SystemExit(f"vla.cpp answers {status} in place of actions.")
        actions = np.ctypeslib.as_array(found, (count.value,)).reshape(initial.shape).copy()
        self._library.vla_free_actions(found)
        self._library.vla_last_stats(self._model, ctypes.byref(stats))
        return actions, [stats.vision / 1e3, (stats.total - stats.vision) / 1e3]


@click.command(context_settings={"show_default": True})
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.option("--library", required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--model", required=True, type=click.Path(exists=True, path_type=Path))
@race_options
def main(folder: Path, library: Path, model: Path, threads: int, rounds: int, fp32: bool) -> None:
    """Time calls of the policy in FOLDER, and of vla.cpp with the same weights."""
    prompt = prompt_of(folder, policy_of(folder), observed(folder)[0])
    race(folder, {"vla.cpp": VlaCpp(library, model, threads, prompt)}, threads, rounds, fp32)


if __name__ == "__main__":
    main()
