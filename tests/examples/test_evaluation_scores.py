"""Score against latency, and episodes on several processes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bootstrap import Estimate
from episodes import Episodes
from jobs import Processes, fill_cache
from score_plot import Timed, plot_scores, time_calls
from variants import NoiseShape, Variant, open_variant

from tests.plans import store_schedules
from ttscompile.artifact.load import load_artifact
from ttscompile.core.lattice import uniform_plan


class Sleeper:
    """A policy of a known latency, which counts."""

    def __init__(self, log: list[Any], name: str) -> None:
        self.log, self.name = log, name

    def reset(self, seed: int | None = None) -> None:
        self.log.append((self.name, "reset"))

    def predict_action(self, obs_dict: Any, *, noise: Any, plan: Any = "default") -> None:
        assert obs_dict["obs"].shape == (1, 2, 20)
        self.log.append((self.name, plan, float(noise.initial[0, 0, 0])))


def test_calls_are_timed_in_turn_with_equal_noise() -> None:
    log: list[Any] = []
    shape = NoiseShape(3, (4, 2), True)
    first: Any = Sleeper(log, "a")
    second: Any = Sleeper(log, "b")
    variants = [Variant("a", first, None, shape), Variant("b", second, "dense", shape)]
    found = time_calls(variants, {"obs": np.zeros((7, 2, 20), np.float32)}, calls=3)
    assert [one.label for one in found] == ["a", "b"]
    assert all(0 < one.median <= one.p90 for one in found)
    assert log[:2] == [("a", "reset"), ("b", "reset")]
    calls = log[2:]
    assert [sorted(pair) for pair in zip([c[:2] for c in calls[::2]], [c[:2] for c in calls[1::2]], strict=True)] == [
        [("a", "default"), ("b", "dense")]
    ] * 5
    assert [call[0] for call in calls] == [*"abbaabbaab"]  # nobody always runs after the same one
    assert [a[2] == b[2] for a, b in zip(calls[::2], calls[1::2], strict=True)] == [True] * 5
    assert len({call[2] for call in calls}) == 5


def test_no_call_is_spared_the_frames_of_the_one_before() -> None:
    log: list[Any] = []

    class Seeing(Sleeper):
        def forget_frames(self) -> None:
            self.log.append((self.name, "forgets"))

    policy: Any = Seeing(log, "a")
    variant = Variant("a", policy, None, NoiseShape(3, (4, 2), True))
    time_calls([variant], {"obs": np.zeros((7, 2, 20), np.float32)}, calls=2)
    assert [one[1] for one in log] == ["reset", *["forgets", "default"] * 4]


def test_the_picture_is_the_same_file_twice(tmp_path: Path) -> None:
    scores = [Estimate(0.9, 0.85, 0.95), Estimate(0.8, 0.7, 0.88)]
    for name in ("one.png", "two.png"):
        plot_scores(
            ["dense", "sparse"], scores, [Timed("dense", 600, 620), Timed("sparse", 36, 40)], tmp_path / name, "T"
        )
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


@pytest.mark.slow
def test_processes_fill_the_cache_with_the_episodes_of_one(compiled_pusht: Path, tmp_path: Path) -> None:
    """Two short-lived processes against this one; only what is missing is run."""
    import shutil

    artifact = tmp_path / "sparse"
    shutil.copytree(compiled_pusht, artifact)
    manifest = load_artifact(artifact).manifest
    plan = uniform_plan(manifest.steps, len(manifest.blocks), 1)
    store_schedules(artifact, None, {"one": plan}, "one", {"learned": ["interval"]})
    text, told = f"{artifact}:one", []

    def fill() -> None:
        cache = tmp_path / "cache"
        fill_cache("pusht", [text], [7, 8], 1, "onnxruntime", cache, Processes(2), lambda *shown: told.append(shown))

    fill()
    assert told == [(text, 0), (text, 1), (text, 2)]
    cache = Episodes(tmp_path / "cache", "pusht", open_variant(text, "onnxruntime", 1), "onnxruntime")
    assert [(kept := cache.read(seed)) and kept.seed for seed in (7, 8)] == [7, 8]
    told.clear()
    fill()
    assert told == [(text, 2)]
    pinned = open_variant(f"{text}:pinned", "onnxruntime", 1)
    assert (pinned.plan, pinned.noise.pinned) == ("one", True)
    other = open_variant(f"{text}:other", "onnxruntime", 1)
    assert (other.plan, other.noise.pinned, other.noise.other) == ("one", False, True)
    assert not open_variant(text, "onnxruntime", 1).noise.pinned
