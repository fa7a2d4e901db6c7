"""``fetch_blocks`` in LeRobot: what its commands are given is what the world of the evaluation shows."""

import os
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

os.environ.setdefault("MUJOCO_GL", "egl")  # read when MuJoCo is imported; there is no display
pytestmark = pytest.mark.skipif(
    any(find_spec(name) is None for name in ("lerobot", "gymnasium_robotics")),
    reason="NO TESTS OF FETCH-BLOCKS IN LEROBOT: lerobot or gymnasium-robotics is not installed; make test-lerobot",
)

FOLDER = Path(__file__).parents[2] / "examples" / "policies" / "vla"
SEEDS = [100_003, 100_011]


@pytest.fixture
def worlds(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two episodes at a time, as ``lerobot-eval`` makes them."""
    import lerobot.scripts.lerobot_eval  # noqa: F401  # first, as there: OSMesa's LLVM before triton's breaks that
    from lerobot.configs.parser import load_plugin
    from lerobot.envs.configs import EnvConfig

    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    load_plugin("lerobot_fetch_blocks")
    made = EnvConfig.get_choice_class("fetch_blocks")().create_envs(2)["fetch_blocks"][0]
    yield made
    made.close()


def test_lerobot_sees_what_the_evaluation_sees(worlds: Any) -> None:
    from environments.fetch_blocks import FetchBlocks
    from lerobot.envs.utils import preprocess_observation

    seen = preprocess_observation(worlds.reset(seed=SEEDS)[0])
    told = worlds.call("task_description")
    own = FetchBlocks()
    for stream, seed in enumerate(SEEDS):
        own.reset(seed)
        assert told[stream] == own.instruction
        for key, expected in own.observe().items():
            if ".language." not in key:
                np.testing.assert_allclose(seen[key][stream].numpy(), expected, rtol=0, atol=1e-6, err_msg=key)
    own.close()
    assert worlds.call("_max_episode_steps") == (own.max_steps, own.max_steps)


def test_an_episode_ends_with_success_and_is_not_driven_on(worlds: Any) -> None:
    from experts import act

    worlds.reset(seed=SEEDS)
    own = [each.unwrapped._world for each in worlds.envs]
    told = np.zeros(2, bool)
    for _ in range(own[0].max_steps):
        *_, terminated, truncated, _ = worlds.step(np.stack([act(world, world.task) for world in own]))
        told |= terminated
        assert not truncated.any(), "the expert is in time"
        if told.all():
            break
    assert told.all() and all(world.success for world in own)
    before = [world.grip for world in own]
    rewards = worlds.step(np.ones((2, 4), np.float32))[1]
    assert rewards.tolist() == [0.0, 0.0]
    np.testing.assert_array_equal([world.grip for world in own], before)
