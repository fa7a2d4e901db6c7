"""The U-Net for Push-T: its checkpoint compiled and eager, and what it was trained on."""

from pathlib import Path

import numpy as np
import pytest
from original import EagerPolicy
from variants import open_variant, seeded_noise

import ttscompile
from tests.examples.recipes import script
from tests.rounding import PROMISED

FOLDER = Path(__file__).parents[2] / "examples" / "policies" / "unet"
CHECKPOINT = FOLDER / "pusht_unet_ema_fp16.ckpt"
WORLD = 512
"""Pixels, the range of the actions."""


@pytest.mark.soak
def test_the_checkpoint_compiles_and_dense_is_the_eager_policy(tmp_path: Path) -> None:
    program = ttscompile.convert(CHECKPOINT, tmp_path / "compiled")
    assert [block.kind for block in program.blocks] == ["network"]
    eager = EagerPolicy(CHECKPOINT, threads=1)
    dense = open_variant(f"{tmp_path / 'compiled'}:dense", "onnxruntime", 1)
    noise = seeded_noise(eager.noise, [0, 1], call=0)
    obs = np.random.default_rng(0).uniform(100, 400, (2, 2, 20)).astype(np.float32)
    expected = eager.predict_action({"obs": obs}, noise=noise)
    found = dense.policy.predict_action({"obs": obs}, noise=noise, plan="dense")
    assert found["action"].shape == (2, 8, 2)
    assert np.abs(found["action"][0] - found["action"][1]).max() > 1, "other observations, other actions"
    for key in ("action", "action_pred"):
        np.testing.assert_allclose(found[key], expected[key], rtol=0, atol=PROMISED * WORLD)


def test_the_checkpoint_fits_in_a_repository() -> None:
    assert CHECKPOINT.stat().st_size < 20e6


def test_examples_are_cut_within_an_episode() -> None:
    """As the original cuts them: one observation before the first action, seven repeated actions after the last."""
    pytest.importorskip("gym_pusht", reason="the recipe takes its observations from gym-pusht's adapter")
    frames = script(FOLDER, "train").windows(np.array([3, 23]))
    assert frames.min() == 3, "an episode of three frames is too short for an example"
    assert frames[0].tolist() == [3, *range(3, 18)]
    assert frames[-1].tolist() == [*range(14, 23), *[22] * 7]
    assert frames[:, 0].tolist() == [3, *range(3, 15)]
