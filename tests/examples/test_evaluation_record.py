"""The recorded file is a trajectory file."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from record import Wanderer, save_trajectories

from ttscompile import Affine, ChunkSpec, Noise


def episode(calls: int, start: int) -> dict[str, Any]:
    obs = np.arange(start, start + calls * 40, dtype=np.float32).reshape(calls, 2, 20)
    return {"obs": obs, "observation.image": np.full((calls, 1, 3, 4, 4), start % 251, np.uint8)}


def test_rows_are_calls_in_order_and_ends_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "new" / "calls.npz"
    episodes = [episode(3, 0), episode(1, 1000), episode(2, 2000)]
    save_trajectories(path, episodes)
    with np.load(path, allow_pickle=False) as file:
        assert sorted(file.files) == ["episode_ends", "obs", "observation.image"]
        assert file["episode_ends"].tolist() == [3, 4, 6]
        assert file["obs"].dtype == np.float32
        np.testing.assert_array_equal(file["obs"], np.concatenate([e["obs"] for e in episodes]))
        assert file["observation.image"].shape == (6, 1, 3, 4, 4)
        assert file["observation.image"].dtype == np.uint8


def test_the_same_episodes_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.npz", "b.npz"):
        save_trajectories(tmp_path / name, [episode(2, 5)])
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_a_wanderer_goes_where_its_noise_says_and_never_out_of_range() -> None:
    normalizer = Affine(np.array([0.01, 0.02], np.float32), np.array([-1, -2], np.float32))
    chunk = ChunkSpec(2, 1, 5, normalizer)
    wanderer = Wanderer(SimpleNamespace(info=SimpleNamespace(action=chunk), reset=lambda: None))
    initial = np.random.default_rng(0).standard_normal((3, 8, 2)).astype(np.float32) * 9
    action = wanderer.predict_action({}, Noise(initial, None), "dense")["action"]
    assert action.shape == (3, 4, 2)
    assert (action == action[:, :1]).all()
    assert (np.abs(normalizer.normalize(action)) <= 1).all()
    np.testing.assert_allclose(action[:, 0], (np.tanh(initial[:, 0]) + np.array([1, 2])) / [0.01, 0.02], rtol=1e-5)
