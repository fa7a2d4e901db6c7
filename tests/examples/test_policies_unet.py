"""The U-Net for Push-T: its checkpoint compiled and eager, and what it was trained on."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from original import EagerPolicy
from variants import open_variant, seeded_noise

import ttscompile
from tests.rounding import PROMISED

FOLDER = Path(__file__).parents[2] / "examples" / "policies" / "unet"
CHECKPOINT = FOLDER / "pusht_unet_ema_fp16.ckpt"
WORLD = 512
"""Pixels, the range of the actions."""


def script(name: str) -> ModuleType:
    """Loaded under a name of its own: other folders of examples have scripts of the same names.

    What it puts into the path is taken out again: the folder beside it would pass for the package metaworld.
    """
    spec = importlib.util.spec_from_file_location(f"unet_{name}", FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    path = list(sys.path)
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path[:] = path
    return module


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
    frames = script("train").windows(np.array([3, 23]))
    assert frames.min() == 3, "an episode of three frames is too short for an example"
    assert frames[0].tolist() == [3, *range(3, 18)]
    assert frames[-1].tolist() == [*range(14, 23), *[22] * 7]
    assert frames[:, 0].tolist() == [3, *range(3, 15)]
