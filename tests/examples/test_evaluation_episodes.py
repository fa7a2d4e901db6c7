"""Episodes that are kept on disk."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments.pusht import PushT
from episodes import Episodes
from rollout import Episode, run_episodes
from variants import NoiseShape, Variant

from ttscompile import ChunkSpec, ObservationSpec


class Info:
    model_identity, identity, precision, default_plan = "m" * 64, "i" * 64, "fp32", "schedule"
    reuses_tokens, follows = False, False
    observation, action = {"obs": ObservationSpec((2, 20))}, ChunkSpec(2, 1, 9)


class Policy:
    """Counts its calls; moves nowhere."""

    info: Any = Info()
    last_report = None
    calls = 0

    def reset(self) -> None:
        pass

    def predict_action(self, obs_dict: Any, noise: Any = None, plan: Any = None) -> Any:
        self.calls += 1
        return {"action": np.full((len(obs_dict["obs"]), 8, 2), 256.0, np.float32)}


SHAPE = NoiseShape(2, (16, 2), False)


def variant(plan: str | None = None, **changes: Any) -> Variant:
    policy: Any = Policy()
    policy.info = type("Changed", (Info,), changes)()
    return Variant("v", policy, plan, SHAPE)


def episode(seed: int = 7) -> Episode:
    draw = np.random.default_rng(seed)
    return Episode(
        seed,
        "push",
        {"obs": draw.random((3, 2, 20), np.float32), "observation.image": draw.integers(0, 9, (3, 1, 4, 4), np.uint8)},
        draw.random((8, 2), np.float32),
        draw.random(8),
        True,
        {"best coverage": 0.1 + 0.2},
        (0.95, 0.9, 1.0),
        (1.5, 2.5, 3.5),
        (0, 2, 0),
    )


def cached(root: Path, one: Variant, environment: str = "pusht", runtime: str = "onnxruntime") -> Episodes:
    return Episodes(root, environment, one, runtime)


def test_an_episode_is_read_as_it_was_written(tmp_path: Path) -> None:
    cache = cached(tmp_path, variant())
    assert cache.read(7) is None
    cache.write(episode())
    again, first = vars(cache.read(7)), vars(episode())
    assert again.keys() == first.keys()
    for name, value in first.items():
        if name == "windows":
            assert again[name].keys() == value.keys()
        arrays = value if name == "windows" else {"": value} if isinstance(value, np.ndarray) else {}
        for key, array in arrays.items():
            found = again[name][key] if name == "windows" else again[name]
            assert found.dtype == array.dtype
            np.testing.assert_array_equal(found, array)
        assert arrays or again[name] == value
    assert cache.read(8) is None


@pytest.mark.parametrize(
    ("plan", "changes", "found"),
    [
        (None, {}, True),
        ("schedule", {}, True),
        ("dense", {}, False),
        ("fast", {}, False),
        (None, {"identity": "j" * 64}, False),
        (None, {"precision": "int8"}, False),
    ],
)
def test_only_what_computes_the_same_finds_it(
    tmp_path: Path, plan: str | None, changes: dict[str, str], found: bool
) -> None:
    cached(tmp_path, variant()).write(episode())
    assert (cached(tmp_path, variant(plan, **changes)).read(7) is not None) == found
    assert cached(tmp_path, variant(plan, **changes), runtime="reference").read(7) is None


@pytest.mark.parametrize("plan", ["dense", "full"])
def test_calibration_does_not_change_what_a_conversion_makes(tmp_path: Path, plan: str) -> None:
    cached(tmp_path, variant(plan)).write(episode())
    assert cached(tmp_path, variant(plan, identity="j" * 64)).read(7) is not None
    assert cached(tmp_path, variant(plan, model_identity="n" * 64)).read(7) is None
    assert cached(tmp_path, variant("full" if plan == "dense" else "dense")).read(7) is None
    assert cached(tmp_path, variant(plan, reuses_tokens=True)).read(7) is None, "it may act otherwise"
    assert cached(tmp_path, variant(plan, follows=True)).read(7) is None, "its calls begin otherwise"


@pytest.mark.parametrize("noise", [replace(SHAPE, pinned=True), replace(SHAPE, other=True)])
def test_noise_that_is_not_shared_has_episodes_of_its_own(tmp_path: Path, noise: NoiseShape) -> None:
    cached(tmp_path, variant()).write(episode())
    assert cached(tmp_path, replace(variant(), noise=noise)).read(7) is None


def test_a_damaged_file_is_as_good_as_none(tmp_path: Path) -> None:
    cache = cached(tmp_path, variant())
    cache.write(episode())
    (file,) = tmp_path.glob("*/7.npz")
    file.write_bytes(file.read_bytes()[:100])
    assert cache.read(7) is None


def test_another_environment_has_episodes_of_its_own(tmp_path: Path) -> None:
    cached(tmp_path, variant()).write(episode())
    assert cached(tmp_path, variant(), "pusht-pixels").read(7) is None


def test_kept_episodes_are_not_run_again(tmp_path: Path) -> None:
    one = variant()
    cache = cached(tmp_path, one)
    first = run_episodes(PushT, one, [1, 2], 2, cache=cache)
    policy: Any = one.policy
    calls = policy.calls
    done: list[int] = []
    more = run_episodes(PushT, one, [2, 3, 1], 2, done.append, cache)
    assert [e.seed for e in more.episodes] == [2, 3, 1]
    assert 0 < policy.calls - calls <= calls
    np.testing.assert_array_equal(more.episodes[2].scores, first.episodes[0].scores)
    np.testing.assert_array_equal(more.episodes[2].windows["obs"], first.episodes[0].windows["obs"])
    assert done[-1] == 3
