"""SmolVLA beside vla.cpp (github.com/VinRobotics/vla.cpp), the same weights and the same call, taking turns.

    python examples/benchmark/large.py --smolvla --output DIR
    python examples/benchmark/vla_cpp.py DIR --library libvla.so --model smolvla.gguf [--threads 1]

``DIR`` is what ``large.py`` leaves. ``libvla.so`` is vla.cpp's own. ``smolvla.gguf`` is what its
``convert_smolvla_to_gguf.py`` makes of ``DIR/smolvla``, once that has what vla.cpp wants of released checkpoints:
``text_model.norm.weight``, here ones, and ``embed_tokens.weight`` in bf16.

vla.cpp is given pictures of 512 by 512, resized beforehand and not timed; ours resizes in the call. Seconds are of the
clock, so let the machine be quiet.
"""

from __future__ import annotations

import ctypes
import os
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import click
import numpy as np
import torch
from large_calls import plans_of
from large_smolvla import CAMERAS, STATE, call
from torch.nn import functional

import ttscompile
from ttscompile.artifact.load import load_artifact

SIDE = 512
FLOATS, PHASES = 1, 1
"""Of vla.cpp's interface (``vla.h``): pixels as floats from 0 to 1, and times of each phase."""


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


class Rival:
    """vla.cpp with a model.

    Args:
        library: ``libvla.so``.
        model: the GGUF file.
        threads: of its arithmetic.
    """

    def __init__(self, library: Path, model: Path, threads: int) -> None:
        os.environ["VLA_N_THREADS"] = str(threads)
        self._library = ctypes.CDLL(str(library))
        self._library.vla_model_load.restype = ctypes.c_void_p
        self._model = ctypes.c_void_p(self._library.vla_model_load(None, str(model).encode(), None))
        if not self._model:
            raise SystemExit(f"{model}: vla.cpp cannot load it.")

    def predict(self, obs: Mapping[str, np.ndarray], noise: np.ndarray, detail: int = 0) -> np.ndarray:
        """The actions ``[T, D]``, of all channels."""
        pictures = [squared(obs[key]) for key in CAMERAS]
        images = (Image * len(pictures))(*(Image(each.ctypes.data, SIDE, SIDE, FLOATS) for each in pictures))
        state, initial = np.zeros(32, np.float32), np.ascontiguousarray(noise[0])
        state[: obs[STATE].size] = obs[STATE].reshape(-1)
        (tokens,) = (np.ascontiguousarray(obs[key], np.int32) for key in obs if key.endswith("tokens"))
        given = Inputs(
            images,
            len(pictures),
            lang_tokens=tokens.ctypes.data,
            n_lang=tokens.size,
            state=state.ctypes.data,
            noise=initial.ctypes.data,
            timing_detail=detail,
        )
        found, count = ctypes.POINTER(ctypes.c_float)(), ctypes.c_int64()
        status = self._library.vla_predict(self._model, ctypes.byref(given), ctypes.byref(found), ctypes.byref(count))
        if status:
            raise SystemExit(f"vla.cpp answers {status} in place of actions.")
        actions = np.ctypeslib.as_array(found, (count.value,)).reshape(initial.shape).copy()
        self._library.vla_free_actions(found)
        return actions

    def phases(self) -> Stats:
        """Of the last call, which was asked for them."""
        stats = Stats()
        self._library.vla_last_stats(self._model, ctypes.byref(stats))
        return stats


def squared(picture: np.ndarray) -> np.ndarray:
    """A picture ``[..., 3, H, W]`` as lerobot resizes it: in proportion, padded on the left and above."""
    height, width = picture.shape[-2:]
    scale = max(height, width) / SIDE
    size = (int(height / scale), int(width / scale))
    value = torch.from_numpy(picture.reshape(1, 3, height, width).astype(np.float32))
    made = functional.interpolate(value, size, mode="bilinear", align_corners=False)
    padded = functional.pad(made, (SIDE - size[1], 0, SIDE - size[0], 0))
    return np.ascontiguousarray(padded[0].permute(1, 2, 0).numpy())


def timed(run: Callable[[], Any]) -> float:
    """Seconds of the clock."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


@click.command(context_settings={"show_default": True})
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.option("--library", required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--model", required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--threads", default=1, type=click.IntRange(1))
@click.option("--rounds", default=7, type=click.IntRange(1), help="That are counted.")
def main(folder: Path, library: Path, model: Path, threads: int, rounds: int) -> None:
    """Time calls of the policy in FOLDER, and of vla.cpp with the same weights."""
    artifact = load_artifact(folder / "compiled")
    spec, rival = artifact.manifest.spec, Rival(library, model, threads)
    obs, noise = call(spec)
    for key in obs:
        if key.endswith("mask"):
            obs[key] = np.ones_like(obs[key])
    policies = {
        name: ttscompile.load(folder / "compiled", threads=threads, precision=name) for name in ("fp32", "int8")
    }
    plans = plans_of(policies["fp32"].info, 2)
    times: dict[str, list[float]] = {}
    for _ in range(rounds + 1):  # the first does not count
        times.setdefault("vla.cpp", []).append(timed(lambda: rival.predict(obs, noise.initial)))
        for precision, policy in policies.items():
            for name, plan in plans.items():
                policy.forget_frames()

                def ours(policy: Any = policy, plan: Any = plan) -> Any:
                    return policy.predict_action(obs, noise=noise, plan=plan)["action_pred"]

                times.setdefault(f"{name}, {precision}", []).append(timed(ours))
    policies["fp32"].forget_frames()
    exact = policies["fp32"].predict_action(obs, noise=noise, plan="dense")["action_pred"][0]
    off = np.abs(rival.predict(obs, noise.initial, PHASES)[:, : exact.shape[1]] - exact)
    print(f"actions of vla.cpp are off ours by {off.mean():.2g} on average, of at most {np.abs(exact).max():.2g}")
    phases = rival.phases()
    print(f"vla.cpp: vision {phases.vision:.0f} ms, prefix {phases.prefill:.0f} ms, loop {phases.denoise:.0f} ms")
    first = statistics.median(times["vla.cpp"][1:])
    for name, seconds in times.items():
        median = statistics.median(seconds[1:])
        print(f"{median:8.3f} s  {first / median:6.2f} times vla.cpp  {name}")


if __name__ == "__main__":
    main()
