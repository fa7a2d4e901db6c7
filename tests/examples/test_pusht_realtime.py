"""Push-T in real time, briefly: the loop, its figures and its picture."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from environments.pusht import PushT
from realtime import COMPILED, NumberedNoise, World, drive, main
from variants import NoiseShape

import ttscompile

pytestmark = pytest.mark.alone


class Info:
    """Of the Push-T policy, without a policy."""

    def __init__(self, info: ttscompile.PolicyInfo) -> None:
        self.observation, self.action, self.sample = info.observation, info.action, info.sample
        self.plans, self.default_plan = ("dense",), "dense"


class Pusher:
    """Answers at once: go to where the block is."""

    def reset(self) -> None:
        pass

    def predict_action(self, obs_dict: Any, noise: Any, plan: Any) -> Any:
        assert noise.initial.shape == (1, 16, 2)
        block = obs_dict["obs"][:, -1, :18].reshape(1, 9, 2).mean(axis=1)
        return {"action_pred": np.repeat(block[:, None], 16, axis=1)}


@pytest.fixture(scope="module")
def info(compiled_pusht: Path) -> Any:
    return Info(ttscompile.load(compiled_pusht).info)


def test_a_quick_policy_misses_nothing_and_a_slow_one_is_seen_to(info: Any, tmp_path: Path) -> None:
    shape = NoiseShape(4, (16, 2), True)
    quick = drive("quick", NumberedNoise(Pusher(), info, shape, True), 20, 2.0, 0, 3, tmp_path / "quick.json")
    assert quick.missed_ticks <= quick.late_ticks  # none, unless the loop itself stood still
    assert quick.episodes == 1
    if not quick.late_ticks:  # of a busy machine nobody knows how many there are
        assert quick.statistics["ticks"] >= 35

    class Slow(Pusher):
        def predict_action(self, obs_dict: Any, noise: Any, plan: Any) -> Any:
            import time

            time.sleep(0.7)
            return super().predict_action(obs_dict, noise, plan)

    slow = drive("slow", NumberedNoise(Slow(), info, shape, True), 20, 2.0, 0, 3, tmp_path / "slow.json")
    assert slow.missed_ticks > slow.statistics["ticks"] / 3
    assert " > 750 ms" in slow.feasibility
    names = [event["name"] for event in json.loads((tmp_path / "quick.json").read_text())["traceEvents"]]
    assert names.count("tick") == quick.statistics["ticks"]


def test_noise_is_numbered_from_the_seed_of_the_episode(info: Any) -> None:
    seen: list[float] = []

    class Noting(Pusher):
        def predict_action(self, obs_dict: Any, noise: Any, plan: Any) -> Any:
            seen.append(float(noise.initial[0, 0, 0]))
            return super().predict_action(obs_dict, noise, plan)

    policy = NumberedNoise(Noting(), info, NoiseShape(4, (16, 2), True), True)
    obs = {"obs": np.zeros((1, 2, 20), np.float32)}
    for seed in (3, 4, 3):
        policy.reset(seed)
        for _ in range(2):
            policy.predict_action(obs, plan="dense")
    assert seen[:2] == seen[4:]
    assert len(set(seen)) == 4


def test_the_world_goes_on_without_an_action() -> None:
    world = World(first_seed=0)
    assert world.next_episode() == 0
    before = world.frame()["obs"][18:]
    world.step(None)
    assert np.linalg.norm(world.frame()["obs"][18:] - before) < 5
    world.step([300, 300])
    reference = PushT()
    reference.reset(0)
    for action in (reference.rest(), [300, 300]):
        reference.step(np.asarray(action, np.float32))
    np.testing.assert_array_equal(world.frame()["obs"], reference.observe()["obs"])
    assert world.next_episode() == 1
    assert len(world.best) == 1


@pytest.mark.slow
def test_the_script_writes_statistics_traces_and_a_picture(compiled_pusht: Path, tmp_path: Path) -> None:
    """Of the policy before it is calibrated, which is too slow for this: exit status 1."""
    args = [str(compiled_pusht), "--hz", "500", "--minutes", "0.05", "-o", str(tmp_path)]  # whatever the machine is
    result = CliRunner().invoke(main, args)
    assert result.exit_code == 1, result.output
    (run,) = json.loads((tmp_path / "realtime.json").read_text())["runs"]
    assert run["label"] == COMPILED
    assert run["missed_ticks"] > 50
    assert (tmp_path / run["trace"]).exists()
    assert (tmp_path / "realtime.png").read_bytes().startswith(b"\x89PNG")
