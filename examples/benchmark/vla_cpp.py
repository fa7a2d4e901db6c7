"""SmolVLA beside vla.cpp (github.com/VinRobotics/vla.cpp), the same weights and the same call, taking turns.

    python examples/benchmark/large.py --smolvla --output DIR
    python examples/benchmark/vla_cpp.py DIR --library libvla.so --model smolvla.gguf [--threads 1]

``DIR`` is what ``large.py`` leaves. ``libvla.so`` is vla.cpp's own: build it with its CMakeLists, which takes ggml from
llama.cpp. A ggml that is built by itself leaves ``GGML_LLAMAFILE`` off, and is slower. ``smolvla.gguf`` is what its
``convert_smolvla_to_gguf.py`` makes of ``DIR/smolvla``.

In every round both cameras have a new picture in which only an arm has moved. The last contestant reuses tokens, and
the others compute all of it. vla.cpp is given pictures of 512 by 512, resized beforehand. Seconds are of the clock, so
let the machine be quiet.
"""

from __future__ import annotations

import ctypes
import os
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import click
import numpy as np
import torch
from large_calls import lowered, plans_of
from large_smolvla import CAMERAS, STATE, call
from moving import REUSE, arm, picture
from torch.nn import functional

from ttscompile import Noise, Plan
from ttscompile.artifact.load import load_artifact
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy

SIDE = 512
FLOATS = 1
"""Of vla.cpp's interface (``vla.h``): pixels are floats from 0 to 1."""

UNCOUNTED = 2
"""Rounds: where tokens are reused, the first frame is whole, and the second may be the first of its size."""


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

    def predict(self, pictures: Sequence[np.ndarray], obs: Mapping[str, np.ndarray], noise: Noise) -> np.ndarray:
        """The actions ``[T, D]``, of all channels; ``pictures`` are ``squared``."""
        images = (Image * len(pictures))(*(Image(each.ctypes.data, SIDE, SIDE, FLOATS) for each in pictures))
        state, initial = np.zeros(32, np.float32), np.ascontiguousarray(noise.initial[0])
        state[: obs[STATE].size] = obs[STATE].reshape(-1)
        (tokens,) = (np.ascontiguousarray(obs[key], np.int32) for key in obs if key.endswith("tokens"))
        given = Inputs(
            images,
            len(pictures),
            lang_tokens=tokens.ctypes.data,
            n_lang=tokens.size,
            state=state.ctypes.data,
            noise=initial.ctypes.data,
        )
        found, count = ctypes.POINTER(ctypes.c_float)(), ctypes.c_int64()
        status = self._library.vla_predict(self._model, ctypes.byref(given), ctypes.byref(found), ctypes.byref(count))
        if status:
            raise SystemExit(f"vla.cpp answers {status} in place of actions.")
        actions = np.ctypeslib.as_array(found, (count.value,)).reshape(initial.shape).copy()
        self._library.vla_free_actions(found)
        return actions

    def parts(self) -> list[float]:
        """Seconds of the last call: of both pictures, and of all the rest."""
        stats = Stats()
        self._library.vla_last_stats(self._model, ctypes.byref(stats))
        return [stats.vision / 1e3, (stats.total - stats.vision) / 1e3]


def squared(picture: np.ndarray) -> np.ndarray:
    """A picture ``[..., 3, H, W]`` as lerobot resizes it: in proportion, padded on the left and above."""
    height, width = picture.shape[-2:]
    scale = max(height, width) / SIDE
    size = (int(height / scale), int(width / scale))
    value = torch.from_numpy(picture.reshape(1, 3, height, width).astype(np.float32))
    made = functional.interpolate(value, size, mode="bilinear", align_corners=False)
    padded = functional.pad(made, (SIDE - size[1], 0, SIDE - size[0], 0))
    return np.ascontiguousarray(padded[0].permute(1, 2, 0).numpy())


def timed(policy: CompiledPolicy, obs: Mapping[str, np.ndarray], noise: Noise, plan: Plan) -> tuple[list[float], Any]:
    """Seconds of a call of ours, of the clock: before the loop, and in it; and the actions ``[T, D]``."""
    start = time.perf_counter()
    actions = policy.predict_action(obs, noise=noise, plan=plan)["action_pred"][0]
    took = time.perf_counter() - start
    assert policy.last_report is not None
    before = took * policy.last_report.timings.prologue / policy.last_report.timings.total
    return [before, took - before], actions


def told(times: Mapping[str, Sequence[Sequence[float]]]) -> list[str]:
    """A line for each contestant: medians of its calls that count, and how many of them one call of the first takes."""
    first, lines = None, list[str]()
    for name, calls in times.items():
        counted = calls[UNCOUNTED:]
        total = statistics.median(map(sum, counted))
        first = first or total
        parts = ", ".join(f"{statistics.median(part):.2f}" for part in zip(*counted, strict=True))
        lines.append(f"{total:8.2f} s  {first / total:6.2f} times vla.cpp  {name}: {parts}")
    return lines


@click.command(context_settings={"show_default": True})
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.option("--library", required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--model", required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--threads", default=1, type=click.IntRange(1))
@click.option("--rounds", default=7, type=click.IntRange(1), help="That are counted.")
def main(folder: Path, library: Path, model: Path, threads: int, rounds: int) -> None:
    """Time calls of the policy in FOLDER, and of vla.cpp with the same weights."""
    artifact = load_artifact(folder / "compiled")
    rival, rng = Rival(library.absolute(), model, threads), np.random.default_rng(1)
    obs, noise = call(artifact.manifest.spec)
    for key in obs:
        if key.endswith("mask"):
            obs[key] = np.ones_like(obs[key])
    plans = {name: plans_of(artifact, name, 2) for name in ("fp32", lowered(artifact))}
    policies = {name: open_policy(artifact, threads=threads, plan=own["dense"]) for name, own in plans.items()}
    few, reused = list(plans_of(artifact, "int8", 2, REUSE).items())[-1]
    reusing = open_policy(artifact, threads=threads, plan=reused)
    still = {key: picture(obs[key].shape[-1], rng) for key in CAMERAS}
    times: dict[str, list[list[float]]] = {}
    off: dict[str, list[float]] = {}
    for number in range(rounds + UNCOUNTED):
        for place, key in enumerate(CAMERAS):
            obs[key] = arm(still[key], place + 0.05 * number)[None, None]
        pictures = [squared(obs[key]) for key in CAMERAS]
        found = {"vla.cpp": rival.predict(pictures, obs, noise)}
        times.setdefault("vla.cpp: pictures, the rest", []).append(rival.parts())
        for precision, policy in policies.items():
            for name, plan in plans[precision].items():
                policy.forget_frames()
                seconds, found[f"{name}, {precision}"] = timed(policy, obs, noise, plan)
                times.setdefault(f"{name}, {precision}: before the loop, loop", []).append(seconds)
        seconds, _ = timed(reusing, obs, noise, reused)
        times.setdefault(f"{few}, int8, tokens reused: before the loop, loop", []).append(seconds)
        exact = found["dense, fp32"]
        for name in ("vla.cpp", "dense, int8"):
            off.setdefault(name, []).append(float(np.abs(found[name][:, : exact.shape[1]] - exact).mean()))
    print("\n".join(told(times)))
    size = np.abs(exact).mean()
    for name, values in off.items():
        print(f"{statistics.mean(values):8.2g}  {name}: actions off ours in fp32 on average, of {size:.2g}")


if __name__ == "__main__":
    main()
