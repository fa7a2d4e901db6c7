"""A small policy with what a vision-language model has: cameras and words that are read together, and a state."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

import ttscompile
from tests.families.cameras import ACTIONS, CAMERAS, HORIZON, SIDE, STEPS, WORDS, Denoiser, Patches, Tower
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.ir.graph import Graph
from ttscompile.ir.program import Program
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.samplers.flow import flow_matching_table

Array = npt.NDArray[Any]
Obs = dict[str, Array]
WIDTH, STATE = 192, 4
When = Literal["apart", "last", "first"]
"""The state is read beside the language model, or by it: after everything else, which does not see it, or before."""


class Rows(Patches):
    """``[N, 3, 24, 24]`` -> ``[N, 36, 8]``: of each patch what the vision transformer makes of it."""

    def __init__(self) -> None:
        super().__init__("siglip")

    def forward(self, x: Tensor) -> Tensor:
        return self.out(self.tower(2 * x - 1))


class Grid(Tower):
    """The same by convolutions: of 36 parts of the picture."""

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers:
            x = torch.relu(layer(x))
        return self.out(nn.functional.avg_pool2d(x, 4).flatten(2).transpose(1, 2))


class Layer(nn.Module):
    """Attention of rows among themselves, or of a later one among all; what follows is for each row alone."""

    def __init__(self) -> None:
        super().__init__()
        self.attend, self.hidden, self.out = (nn.Linear(WIDTH, n * WIDTH) for n in (3, 2, 1))
        self.down = nn.Linear(2 * WIDTH, WIDTH)

    def forward(self, x: Tensor, before: Tensor | None = None, shown: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The stream, and keys and values ``[B, T, 2 * WIDTH]`` of all that was seen; each sees what is ``shown``."""
        queries, own = self.attend(x).split((WIDTH, 2 * WIDTH), -1)
        seen = own if before is None else torch.cat([before, own], 1)
        keys, values = seen.chunk(2, -1)
        scores = queries @ keys.transpose(1, 2) * WIDTH**-0.5
        if shown is not None:
            scores = torch.where(shown, scores, -1e9)
        x = x + self.out(scores.softmax(-1) @ values)
        return x + self.down(torch.relu(self.hidden(x))), seen


class Encoder(nn.Module):
    """Observations -> ``[B, features]``: what three layers make of pictures and words, and the state.

    Where a picture has many rows, words that are 0 are not read, and by a ``Grid`` nothing reads what comes later.
    """

    def __init__(self, tower: nn.Module, when: When) -> None:
        super().__init__()
        self.tower, self.when = tower, when
        self.see, self.words = nn.Linear(8, WIDTH), nn.Embedding(16, WIDTH)
        self.layers, self.state = nn.ModuleList(Layer() for _ in range(3)), nn.Linear(STATE, WIDTH)

    def forward(self, obs: dict[str, Tensor]) -> Tensor:
        images = [obs[key] for key in CAMERAS]
        seen = [self.see(self.tower(image.flatten(0, 1))) for image in images]
        each = seen[0].shape[1] if seen[0].ndim == 3 else 1  # rows of a picture
        rows = (own.reshape(-1, image.shape[1] * each, WIDTH) for own, image in zip(seen, images, strict=True))
        x = torch.cat([*rows, self.words(obs["tokens"])], 1)
        state = self.state(obs["state"])
        if self.when == "first":
            x = torch.cat([state[:, None], x], 1)
        cache, shown = [], None
        if each > 1:
            shown = nn.functional.pad(obs["tokens"] > 0, (x.shape[1] - obs["tokens"].shape[1], 0), value=True)[:, None]
        if isinstance(self.tower, Grid) and shown is not None:
            shown = shown & torch.ones(x.shape[1], x.shape[1], dtype=torch.bool).tril()
        for layer in self.layers:
            x, both = layer(x, None, shown)
            cache.append(both)
        read = [both.mean(1) for both in cache]
        if self.when == "last":
            row, read = state[:, None], []
            for layer, before in zip(self.layers, cache, strict=True):
                row, both = layer(row, before)
                read.append(both.mean(1))
        return torch.cat([*read, state], -1)


def policy(
    when: When = "apart", frames: int = 1, tower: Callable[[], nn.Module] = Tower
) -> tuple[nn.Module, PolicySpec]:
    """A module and its specification."""
    torch.manual_seed(0)
    observations = {key: ObservationSpec((frames, 3, SIDE, SIDE), bounds=(0.0, 1.0)) for key in CAMERAS}
    observations["state"] = ObservationSpec((STATE,), window=False)
    observations["tokens"] = ObservationSpec((WORDS,), dtype="int64", window=False, bounds=(0, 15))
    spec = PolicySpec((HORIZON, ACTIONS), observations, flow_matching_table(STEPS), ChunkSpec(ACTIONS, 0, 2))
    encoder = Encoder(tower(), when)
    return EncodedDenoiser(encoder, Denoiser(6 * WIDTH + WIDTH)).eval(), spec


def compile_all(folder: Path) -> None:
    """``one`` and ``two`` frames of each camera, the first with its single file; and one that reuses ``tokens``."""
    ttscompile.compile_denoiser(*policy(), folder / "one", single_file=folder / "one.onnx")
    ttscompile.compile_denoiser(*policy(frames=2), folder / "two")
    ttscompile.compile_denoiser(*policy(tower=partial(Patches, "clip")), folder / "tokens")


def compile_rows(folder: Path) -> None:
    """Two whose scene has tokens: ``rows``, whose towers have, too, and in int8; ``grid`` with its single file."""
    ttscompile.compile_denoiser(*policy(tower=Rows), folder / "rows", precision="int8")
    ttscompile.compile_denoiser(*policy("last", tower=Grid), folder / "grid", single_file=folder / "grid.onnx")


def observation(left: int = 0, right: int = 1, word: int = 2, state: int = 3, frames: int = 1) -> Obs:
    """One stream, of which each number decides one observation; a window holds the frames up to a number."""

    def shown(number: int) -> Array:
        rng = np.random.default_rng(number)
        return 0.1 + 0.5 * rng.random((3, SIDE, SIDE), dtype=np.float32)

    cameras = zip(CAMERAS, (left, right + 1000), strict=True)
    seen = {key: np.stack([shown(n - frames + 1 + i + 100) for i in range(frames)])[None] for key, n in cameras}
    moved = np.random.default_rng(state).standard_normal((1, STATE), dtype=np.float32)
    return {**seen, "state": moved, "tokens": np.full((1, WORDS), word)}


def together(*streams: Obs) -> Obs:
    """A batch."""
    return {key: np.concatenate([one[key] for one in streams]) for key in streams[0]}


def act(policy: CompiledPolicy, obs: Obs, plan: Any = None) -> Array:
    """The chunk that is predicted with noise of ones."""
    noise = ttscompile.Noise(np.ones((len(obs["state"]), HORIZON, ACTIONS), np.float32))
    return np.asarray(policy.predict_action(obs, noise=noise, plan=plan)["action_pred"])


def scenes(policy: CompiledPolicy) -> tuple[int, int]:
    """That the last call computed, and that were known."""
    assert policy.last_report is not None
    return policy.last_report.frames.scenes, policy.last_report.frames.scenes_remembered


def without_scene(program: Program) -> Program:
    """The same with the scene in the condition graph."""
    pieces = program.pieces
    scene, rest = pieces.scene, pieces.condition
    if scene is None:
        return program
    inputs = {name: kind for name, kind in {**scene.inputs, **rest.inputs}.items() if name not in scene.producers()}
    outputs = tuple(pieces.conditions)
    whole = Graph(inputs, {**scene.constants, **rest.constants}, (*scene.nodes, *rest.nodes), outputs)
    return replace(program, pieces=replace(pieces, scene=None, condition=whole))
