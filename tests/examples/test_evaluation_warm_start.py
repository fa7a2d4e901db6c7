"""What a warm start is compared with."""

import json
from pathlib import Path

import click
import numpy as np
import pytest
import warm_start
from click.testing import CliRunner
from rollout import Episode
from variants import NoiseShape, full_plan, open_variant

import ttscompile


def test_the_world_is_changed_to_an_episode_of_the_same_task() -> None:
    episodes = [Episode(i, task, {}, np.zeros((1, 1)), np.zeros(1), True, {}) for i, task in enumerate("abab")]
    assert warm_start.neighbours(episodes) == [2, 3, 0, 1]


@pytest.mark.soak
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


@pytest.mark.slow
def test_a_plan_that_begins_with_a_chunk_has_the_noise_of_its_whole_loop(
    one_layer_checkpoint: Path, tmp_path: Path
) -> None:
    """Its one step draws none, and the loop that it is the end of does."""
    ttscompile.convert(one_layer_checkpoint, tmp_path / "it", sampler="ddpm", steps=4)
    warm_start.add_warm_plans(tmp_path / "it", [1])
    assert full_plan(tmp_path / "it") == "full"
    warm, whole = (open_variant(f"{tmp_path / 'it'}:{plan}", "onnxruntime", 1) for plan in ("warm-1:pinned", "full"))
    assert (warm.plan, warm.policy.info.K, warm.policy.info.follows) == ("warm-1", 1, True)
    assert (warm.noise, whole.noise) == (NoiseShape(4, (16, 2), True, pinned=True), NoiseShape(4, (16, 2), True))
    with pytest.raises(click.BadParameter, match="expected one plan; found dense:warm-1"):
        open_variant(f"{tmp_path / 'it'}:dense:warm-1", "onnxruntime", 1)
