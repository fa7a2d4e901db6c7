"""The policy of Meta-World's tasks: its checkpoint compiled and eager, its demonstrations, what it was trained on."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from original import EagerPolicy
from variants import open_variant, seeded_noise

import ttscompile
from tests.examples.recipes import script
from tests.rounding import PROMISED

FOLDER = Path(__file__).parents[2] / "examples" / "policies" / "metaworld"
CHECKPOINT = FOLDER / "metaworld_dpt_ema_fp16.ckpt"
TASKS = 12


def windows() -> np.ndarray:
    """Of two tasks; the numbers are about those of a table with a hand above it."""
    rng = np.random.default_rng(0)
    obs = rng.uniform(-0.2, 0.6, (2, 2, 30 + TASKS)).astype(np.float32)
    obs[..., 30:] = np.eye(TASKS, dtype=np.float32)[[2, 7]][:, None]
    return obs


@pytest.mark.soak
def test_the_checkpoint_compiles_and_dense_is_the_eager_policy(tmp_path: Path) -> None:
    ttscompile.convert(CHECKPOINT, tmp_path / "compiled")
    eager = EagerPolicy(CHECKPOINT, threads=1)
    dense = open_variant(f"{tmp_path / 'compiled'}:dense", "onnxruntime", 1)
    assert dense.noise == eager.noise
    noise = seeded_noise(eager.noise, [0, 1], call=0)
    expected = eager.predict_action({"obs": windows()}, noise=noise)
    found = dense.policy.predict_action({"obs": windows()}, noise=noise, plan="dense")
    assert found["action_pred"].shape == (2, 8, 4)
    assert np.abs(found["action"][0] - found["action"][1]).max() > 0.1, "other tasks, other actions"
    for key in ("action", "action_pred"):
        np.testing.assert_allclose(found[key], expected[key], rtol=0, atol=PROMISED * 2)


def test_the_checkpoint_fits_in_a_repository() -> None:
    assert CHECKPOINT.stat().st_size < 20e6


def test_examples_are_cut_within_an_episode() -> None:
    """As the original cuts them: an observation before the first action, five repeated actions after the last."""
    frames = script(FOLDER, "train").windows(np.zeros(7), np.array([3, 7]))
    assert frames.tolist() == [
        [0, 0, 1, 2, 2, 2, 2, 2],
        [0, 1, 2, 2, 2, 2, 2, 2],
        [3, 3, 4, 5, 6, 6, 6, 6],
        [3, 4, 5, 6, 6, 6, 6, 6],
        [4, 5, 6, 6, 6, 6, 6, 6],
    ]


def test_no_example_executes_actions_during_a_push() -> None:
    pushed = np.zeros(20)
    pushed[[8, 9]] = 1
    frames = script(FOLDER, "train").windows(pushed, np.array([20]))
    assert frames[:, 1].tolist() == [0, 1, 2, 10, 11, 12, 13, 14, 15, 16, 17, 18], "the first executed action"
    assert 9 in frames[:, 0], "what a push has done is observed"


@pytest.fixture(scope="module")
def demonstrations() -> ModuleType:
    if importlib.util.find_spec("metaworld") is None:
        pytest.skip("NO TESTS OF META-WORLD'S EXPERTS: metaworld is not installed; pip install 'ttscompile[examples]'")
    return script(FOLDER, "demonstrations")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Constant.s. may be too high")
def test_the_experts_succeed_although_they_are_pushed(demonstrations: ModuleType) -> None:
    environment = demonstrations.MetaWorld()
    assert len(demonstrations.TASKS) == TASKS
    failed, pushed = [], 0.0
    for number, task in enumerate(demonstrations.TASKS):
        episode = demonstrations.demonstrate(environment, demonstrations.FIRST_SEED + number * 10_000, task)
        if episode is None:
            failed.append(task)
            continue
        steps = len(episode["pushed"])
        assert (episode["obs"].shape, episode["action"].shape) == ((steps, 30 + TASKS), (steps, 4))
        assert np.abs(episode["action"]).max() <= 1
        assert (episode["obs"][:, 30:] == np.eye(TASKS)[number]).all()
        pushed += episode["pushed"].sum()
    assert len(failed) <= 2, f"150 of at most 190 episodes of each task succeed; failed: {failed}"
    assert pushed > 0


@pytest.mark.filterwarnings("ignore:Constant.s. may be too high")
def test_a_demonstration_follows_from_its_seed(demonstrations: ModuleType) -> None:
    environment = demonstrations.MetaWorld()
    first = demonstrations.demonstrate(environment, 3, "reach-v3")
    demonstrations.demonstrate(environment, 4, "reach-v3")
    for other in (environment, demonstrations.MetaWorld()):
        again = demonstrations.demonstrate(other, 3, "reach-v3")
        for name, array in first.items():
            np.testing.assert_array_equal(array, again[name])
