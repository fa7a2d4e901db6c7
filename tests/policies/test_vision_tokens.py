"""Of every family whose image encoder is a vision transformer the explanation says that its tokens were found."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ttscompile.driver import transform
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.policies.networks.siglip import SiglipConfig

from . import lerobot_tiny, pis


def told(directory: Path) -> list[str]:
    """What is said of the policy's towers."""
    said: dict[str, tuple[str, ...]] = {}
    transform(*load_checkpoint_policy(directory), explain=said.__setitem__)
    return [note.split(",")[0] for note in said["ReuseTokens"]]


@pytest.mark.soak
def test_of_paligemma(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What pi0 and pi05 see with is one module."""
    monkeypatch.setattr(pis, "SIZES", ((112, 112), pis.SIZES[1]))
    monkeypatch.setattr(pis, "VISION", SiglipConfig(64, 256, 3, 16, image_size=112, patch_size=14))
    for name in ("TEXT", "EXPERT"):
        monkeypatch.setattr(pis, name, replace(getattr(pis, name), layers=1))
    assert told(pis.save("pi05", tmp_path / "policy")) == ["frame_00: 64 tokens"]


@pytest.mark.soak
def test_of_a_clip_for_each_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"hidden_size": 64, "intermediate_size": 256, "num_hidden_layers": 3, "image_size": 64}
    monkeypatch.setattr(lerobot_tiny, "VISION", lerobot_tiny.VISION | sizes)
    monkeypatch.setattr(lerobot_tiny, "SIDE", 72)
    changes: dict[str, Any] = {"image_crop_shape": [64, 64], "use_separate_rgb_encoder_per_camera": True}
    directory = lerobot_tiny.save_policy(tmp_path, ("front", "wrist"), **changes)
    assert told(directory) == ["frame_00: 65 tokens", "frame_01: 65 tokens"]
