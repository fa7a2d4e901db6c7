"""The animation shows what happened, and is small."""

from itertools import pairwise

import numpy as np
import pytest
from animate import CAPTION, Scene, save_animation
from environment import PushT
from PIL import Image
from rollout import Episode


def circling(seed, chunks):
    environment = PushT()
    windows = [environment.reset(seed)]
    for call in range(chunks):
        angle = 0.1 * (8 * call + np.arange(8))
        windows.append(environment.execute(256 + 120 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)))
    return Episode(
        seed,
        np.stack(windows[:-1]),
        np.stack(environment.states),
        np.stack(environment.targets),
        np.array(environment.coverages),
    )


def test_picture_shows_agent_block_and_target_where_they_are():
    state = np.array([100.0, 400.0, 300.0, 200.0, 0.0])
    picture = np.asarray(Scene().picture(state, np.array([450.0, 60.0]), "", size=512)).astype(int)
    assert picture.shape == (512 + CAPTION, 512, 3)
    agent, block, target, nothing = picture[400, 100], picture[215, 300], picture[60, 450], picture[450, 450]
    assert agent[2] > agent[0] + 80  # royal blue
    np.testing.assert_allclose(block, [119, 136, 153], atol=40)  # light slate grey
    assert target[0] > target[1] + 100  # red
    assert nothing.min() > 240


@pytest.mark.parametrize("every", [2, 5])
def test_animation_is_readable_and_small(tmp_path, every):
    path = tmp_path / "pictures" / "episode.gif"
    longer, shorter = circling(0, 6), circling(1, 3)
    save_animation(path, [longer, shorter], ["dense", "compiled"], size=160, every=every)
    assert path.stat().st_size < 1_500_000
    with Image.open(path) as image:
        assert image.format == "GIF"
        assert image.size == (320, 160 + CAPTION)
        assert image.n_frames == len(range(0, 48, every)) + 1
        frames = []
        for i in range(image.n_frames):
            image.seek(i)
            frames.append(np.asarray(image.convert("RGB")).astype(int))
    changes = [np.abs(b - a) for a, b in pairwise(frames)]
    assert all(change[:, :160].max() > 50 for change in changes)  # the longer one moves all the time
    assert changes[-1][:160, 160:].max() == 0  # the shorter one holds its last frame
