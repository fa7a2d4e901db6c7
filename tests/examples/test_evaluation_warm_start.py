"""What a warm start is compared with."""

import json
from pathlib import Path

import numpy as np
import pytest
import warm_start
from click.testing import CliRunner
from rollout import Episode


def test_the_world_is_changed_to_an_episode_of_the_same_task() -> None:
    episodes = [Episode(i, task, {}, np.zeros((1, 1)), np.zeros(1), True, {}) for i, task in enumerate("abab")]
    assert warm_start.neighbours(episodes) == [2, 3, 0, 1]


@pytest.mark.slow
def test_it_measures_a_policy_of_one_layer(one_layer_checkpoint: Path) -> None:
    arguments = [str(one_layer_checkpoint), "--sampler", "ddim", "--steps", "3", "--evaluations", "1", "--json"]
    sizes = ["--episodes", "2", "--compared", "2", "--threads", "1"]
    result = CliRunner().invoke(warm_start.main, [*arguments, *sizes], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert [one["label"] for one in told] == ["the whole loop", "its last 1 steps, warm", "1 steps"]
    assert all(one["reaction"][name] > 0 for one in told[1:2] for name in ("same", "changed"))
    warm = [episode["score"] for episode in told[1]["episodes"]]
    assert warm != [episode["score"] for episode in told[2]["episodes"]]
