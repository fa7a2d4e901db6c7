"""The animation shows what happened, and is small."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from animate import CAPTION, save_animation
from environments.pusht import PushT
from PIL import Image
from PIL.GifImagePlugin import GifImageFile
from rollout import Episode, Recorder


def circling(seed: int, steps: int) -> Episode:
    one = Recorder(PushT(), seed)
    one.windows.append(one.look())
    for angle in 0.1 * np.arange(steps):
        one.step(256 + 120 * np.array([np.cos(angle), np.sin(angle)], np.float32))
    return one.episode()


@pytest.mark.parametrize(("hz", "every"), [(10.0, 2), (25.0, 5)])
def test_animation_is_readable_and_small(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hz: float, every: int
) -> None:
    monkeypatch.setattr(PushT, "hz", hz)
    path = tmp_path / "pictures" / "episode.gif"
    longer, shorter = circling(0, 48), circling(1, 24)
    save_animation(path, PushT, [longer, shorter], ["dense", "compiled"], size=160)
    assert path.stat().st_size < 1_500_000
    with Image.open(path) as image:
        assert isinstance(image, GifImageFile)
        assert image.format == "GIF"
        assert image.size == (320, 160 + CAPTION)
        assert image.n_frames == len(range(0, 48, every)) + 1
        frames = []
        for i in range(image.n_frames):
            image.seek(i)
            frames.append(np.asarray(image.convert("RGB")).astype(int))
    red = [(f[:160, :160, 0] > f[:160, :160, 1:].max(-1) + 60).sum() for f in frames[1:]]
    assert min(red) > 3, "where the agent is sent is seen in every frame"
    changes = [np.abs(b - a) for a, b in pairwise(frames)]
    assert all(change[:, :160].max() > 50 for change in changes)  # the longer one moves all the time
    assert changes[-1][:160, 160:].max() == 0  # the shorter one holds its last frame
