"""Small policies that see: cameras and an instruction, with towers just large enough to be pieces of their own."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

import ttscompile
from tests.once import Once
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.core.plan import Plan
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.policies.networks.clip import ClipVision, VisionConfig
from ttscompile.policies.networks.internvl import Prompt
from ttscompile.policies.networks.language_layers import LanguageConfig, Norm
from ttscompile.policies.networks.qwen3_vl import Qwen3VL, Qwen3VLConfig, QwenVisionConfig
from ttscompile.policies.networks.qwen25_vl import Qwen25VL, Qwen25VLConfig
from ttscompile.policies.networks.siglip import Siglip, SiglipConfig
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.samplers.flow import flow_matching_table

Array = npt.NDArray[Any]
TO, SIDE, PATCH, WORDS = 2, 24, 4, 8
CAMERAS = ("left", "right")
STEPS, HORIZON, ACTIONS = 3, 6, 3
SEEING = ("clip", "siglip", "qwen", "windows")
"""Towers that are vision transformers."""


class Tower(nn.Module):
    """``[N, 3, 24, 24]`` -> ``[N, 8]``, 6 MFLOP an image."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Conv2d(n, 24, 3, padding=1) for n in (3, 24))
        self.out = nn.Linear(24, 8)

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers:
            x = torch.relu(layer(x))
        return self.out(x.mean((2, 3)))


class Patches(nn.Module):
    """``[N, 3, 24, 24]`` -> ``[N, 8]`` by a vision transformer of 36 patches; ``clip`` has a class token, too.

    ``qwen`` turns queries and keys by rows and columns, and gives squares of patches from two of its layers; of
    ``windows``, which is Qwen2.5-VL's, all but the second look at nine parts of the picture, each at itself.
    """

    def __init__(self, kind: str) -> None:
        super().__init__()
        sizes: Any = {"hidden_size": 64, "intermediate_size": 256, "num_hidden_layers": 3, "num_attention_heads": 2}
        clip = VisionConfig(**sizes, image_size=SIDE, patch_size=PATCH)
        siglip = SiglipConfig(**sizes, image_size=SIDE, patch_size=PATCH)
        if kind == "qwen":
            vision = QwenVisionConfig(**sizes, patch_size=PATCH, table=SIDE // PATCH, stacked=(1,))
            text = LanguageConfig(width=32, hidden=32, layers=0, heads=1, groups=1, channels=32)
            grids = ((SIDE // PATCH, SIDE // PATCH),)
            whole = Qwen3VL(Qwen3VLConfig(vision, text, 1, (5, 5), 1e4, grids), Prompt((), 0))
            self.tower: nn.Module = whole.visual
        elif kind == "windows":
            layers = LanguageConfig(64, 256, layers=3, heads=2, groups=2, channels=32, biased=True, whole=True)
            text = LanguageConfig(width=64, hidden=32, layers=0, heads=1, groups=1, channels=32)
            own = Qwen25VLConfig(layers, PATCH, 2, 1, frozenset({1}), text, 1, (6, 5, 5), 1e4)
            self.tower = Qwen25VL(own.of_images([(SIDE, SIDE)]), ()).visual
        else:
            self.tower = ClipVision(clip) if kind == "clip" else Siglip(siglip, (SIDE, SIDE))
        self.out = nn.Linear(64, 8)
        self.pooled = kind == "clip"
        with torch.no_grad():
            for norm in (each for each in self.tower.modules() if isinstance(each, Norm)):
                norm.weight.fill_(1)  # they wait for weights, and would give nothing
            (patches,) = (each for each in self.tower.modules() if isinstance(each, nn.Conv2d))
            patches.weight *= 10  # else what is seen is little beside positions

    def forward(self, x: Tensor) -> Tensor:
        seen = self.tower(2 * x - 1)
        return self.out(seen if self.pooled else seen.mean(1))


class Eyes(nn.Module):
    """What the cameras see, as ``kind`` says:

    ``each``: a tower for each camera; ``shared``: one looks at all of them in turn; ``stacked``: at all at once;
    ``mixed``: at the mean of the window's frames; ``channels``: at the window as one picture with more colours;
    ``clip``, ``siglip``, ``qwen``, ``windows``: one that is a vision transformer looks at all at once.
    """

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind
        sees = kind in SEEING
        self.towers = nn.ModuleList(Patches(kind) if sees else Tower() for _ in range(2 if kind == "each" else 1))
        self.merge = nn.Conv2d(3 * TO, 3, 1)

    def forward(self, images: list[Tensor]) -> Tensor:
        """By camera ``[B, To, 3, H, W]`` -> ``[B, features]``."""
        if self.kind == "mixed":
            images = [x - x.mean(1, keepdim=True) for x in images]
        if self.kind == "channels":
            return torch.cat([self.towers[0](self.merge(x.flatten(1, 2))) for x in images], -1)
        rows = [x.flatten(0, 1) for x in images]
        if self.kind in ("stacked", *SEEING):
            seen = self.towers[0](torch.stack(rows, 1).flatten(0, 1))
            return seen.reshape(-1, TO * len(images) * seen.shape[-1])
        own = [self.towers[i % len(self.towers)](x) for i, x in enumerate(rows)]
        return torch.cat([x.reshape(-1, TO * x.shape[-1]) for x in own], -1)


class Reader(nn.Module):
    """An instruction: tokens and which of them count -> ``[B, 8]``."""

    def __init__(self) -> None:
        super().__init__()
        self.embed, self.layers = nn.Embedding(16, 256), nn.ModuleList(nn.Linear(256, 256) for _ in range(6))
        self.out = nn.Linear(256, 8)

    def forward(self, tokens: Tensor, mask: Tensor) -> Tensor:
        x = self.embed(tokens) * mask[..., None]
        for layer in self.layers:
            x = torch.relu(layer(x))
        return self.out(x.mean(1))


class Encoder(nn.Module):
    """Observations -> ``[B, features]``."""

    def __init__(self, kind: str, told: bool) -> None:
        super().__init__()
        self.eyes, self.reader = Eyes(kind), Reader() if told else None

    def forward(self, obs: Mapping[str, Tensor]) -> Tensor:
        parts = [self.eyes([obs[key] for key in CAMERAS]), obs["state"].flatten(1)]
        if self.reader is not None:
            parts.append(self.reader(obs["tokens"], obs["mask"]))
        return torch.cat(parts, -1)


class Denoiser(nn.Module):
    """Residual blocks that see the features."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.embed, self.head = nn.Linear(ACTIONS, 16), nn.Linear(16, ACTIONS)
        self.blocks = nn.ModuleList(nn.Linear(16, 16) for _ in range(2))
        self.read = nn.Linear(features, 16)

    def forward(self, sample: Tensor, timestep: Tensor, features: Tensor) -> Tensor:
        x, seen = self.embed(sample) + timestep.reshape(-1, 1, 1), self.read(features)[:, None]
        for block in self.blocks:
            x = x + torch.relu(block(x) + seen)
        return self.head(x)


def compile_seeing(folder: Path) -> None:
    """A policy whose two cameras share a tower, with an instruction: the artifact, and the single file."""
    module, spec = policy("shared", told=True)
    ttscompile.compile_denoiser(module, spec, folder / "artifact", single_file=folder / "whole.onnx")


def policy(kind: str, told: bool = False) -> tuple[nn.Module, PolicySpec]:
    """A module and its specification."""
    torch.manual_seed(0)
    features = 8 * (2 if kind == "channels" else 2 * TO) + 4 * TO + 8 * told
    observations = {key: ObservationSpec((TO, 3, SIDE, SIDE), bounds=(0.0, 1.0)) for key in CAMERAS}
    observations["state"] = ObservationSpec((TO, 4))
    if told:
        observations["tokens"] = ObservationSpec((WORDS,), dtype="int64", window=False, bounds=(0, 15))
        observations["mask"] = ObservationSpec((WORDS,), dtype="bool", window=False, bounds=(0, 1))
    spec = PolicySpec((HORIZON, ACTIONS), observations, flow_matching_table(STEPS), ChunkSpec(ACTIONS, TO - 1, TO + 1))
    return EncodedDenoiser(Encoder(kind, told), Denoiser(features)).eval(), spec


def compiled_tokens(once: Once) -> Path:
    """A folder with the policy of kind ``clip``, whose encoder has tokens, in int8 too: ``artifact``."""
    return once.folder(
        "tokens", lambda folder: ttscompile.compile_denoiser(*policy("clip"), folder / "artifact", precision="int8")
    )


def picture(number: int) -> Array:
    return 0.1 + 0.5 * np.random.default_rng(number).random((3, SIDE, SIDE), dtype=np.float32)


def moved(image: Array, patch: int, by: float = 0.3) -> Array:
    """The picture with another patch in this place."""
    image, (y, x) = image.copy(), divmod(patch, SIDE // PATCH)
    image[:, y * PATCH : (y + 1) * PATCH, x * PATCH : (x + 1) * PATCH] += np.float32(by)
    return image


def frame(*streams: tuple[Array, Array]) -> dict[str, Array]:
    """What the two cameras of each stream show."""
    seen = {key: np.stack([pair[i] for pair in streams]) for i, key in enumerate(CAMERAS)}
    return {**seen, "state": np.zeros((len(streams), 4), np.float32)}


def act(
    policy: CompiledPolicy, before: dict[str, Array], newest: dict[str, Array], plan: str | Plan | None = None
) -> Array:
    noise = ttscompile.Noise(np.ones((len(newest["state"]), HORIZON, ACTIONS), np.float32))
    window = {key: np.stack([before[key], value], 1) for key, value in newest.items()}
    return np.asarray(policy.predict_action(window, noise=noise, plan=plan)["action_pred"])


def counted(policy: CompiledPolicy) -> tuple[int, int]:
    """Tokens that the last call computed, of how many."""
    assert policy.last_report is not None
    return policy.last_report.frames.tokens, policy.last_report.frames.of


def happened(what: str, shown: list[Array], where: int, much: float) -> list[Array]:
    """Two pictures after something has happened to the first, or to both."""
    one, other = shown
    rng = np.random.default_rng(where)
    match what:
        case "patch":
            one = moved(one, where, much)
        case "some":
            for patch in rng.choice(36, size=1 + where % 20, replace=False):
                one = moved(one, int(patch), much * rng.random())
        case "light":
            one, other = one + np.float32(much), other + np.float32(much)
        case "noise":
            one = one + np.float32(much) * rng.random(one.shape, np.float32)
        case "shifted":
            one = np.roll(one, where % SIDE, axis=where % 2 + 1)
        case "cut":
            one = picture(where)
        case "swapped":
            one, other = other, one
    return [one, other]
