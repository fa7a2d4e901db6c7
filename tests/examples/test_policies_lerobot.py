"""The policies that lerobot trained: compiled, they give what lerobot itself gave; and what was drawn for them."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments.pusht import PushT, observation
from environments.pusht_pixels import PushTPixels

import ttscompile
from tests.once import Once
from tests.rounding import PROMISED
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.contestants import original_policy
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.ir.program import Program

POLICIES = Path(__file__).parents[2] / "examples" / "policies"
TASK = "push the T onto its place"
WORLD = 512.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["flow", pytest.param("pixels", marks=pytest.mark.soak)])
def test_dense_compiled_is_what_lerobot_answered(name: str, once: Once) -> None:
    def convert(directory: Path) -> Program:
        return ttscompile.convert(POLICIES / name / "policy", directory, task=TASK)

    folder = once.compiled(f"policies-{name}", convert)[0]
    policy = ttscompile.load(folder)
    with np.load(POLICIES / name / "answers.npz", allow_pickle=False) as file:
        answers = {key: file[key] for key in file.files}
    windows = {key: answers[key] for key in policy.info.observation}
    noise = ttscompile.Noise(answers["noise"], None)
    found = policy.predict_action(windows, noise=noise, plan="dense")["action"]
    assert found.shape == answers["action"].shape
    assert answers["action"].std(axis=0).min() > 1, "other windows, other actions"
    np.testing.assert_allclose(found, answers["action"], rtol=0, atol=PROMISED * WORLD)
    _, original = original_policy(POLICIES / name / "policy", load_artifact(folder).manifest.spec)
    assert [*original.observations] == [*policy.info.observation], "bench gives the original the same instruction"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:normaliser of action. the identity")  # of -1 to 1, as the demonstrations are
@pytest.mark.parametrize("name", ["smolvla", pytest.param("multi_task_dit", marks=pytest.mark.soak)])
def test_dense_compiled_vla_is_what_lerobot_answered(name: str, once: Once) -> None:
    trained = POLICIES / "vla" / "trained" / name

    def convert(directory: Path) -> Program:
        return ttscompile.convert(trained / "policy", directory)

    folder = once.compiled(f"policies-vla-{name}", convert)[0]
    with np.load(trained / "answers.npz", allow_pickle=False) as file:
        answers = {key: file[key] for key in file.files}
    noise, wanted = ttscompile.Noise(answers["noise"], answers.get("steps")), answers["action"]
    given = {key: array for key, array in answers.items() if key.startswith("observation.")}
    tokens = {key: array for key, array in given.items() if ".language." in key}
    frames = {key: array[:, None] for key, array in given.items() if key not in tokens}
    policy = ttscompile.load(folder, plan="dense")
    in_tokens = policy.predict_action({**frames, **tokens}, noise=noise)["action"]
    assert wanted.std(axis=0).max(axis=0).min() > 0.1, "other tasks, other actions"
    np.testing.assert_allclose(in_tokens, wanted, rtol=0, atol=PROMISED)
    policy.reset()
    in_words = policy.predict_action({**frames, "task": answers["instruction"].tolist()}, noise=noise)["action"]
    np.testing.assert_array_equal(in_words, in_tokens)


def test_one_instruction_in_a_policy_whose_tokenizer_is_not_clips_own() -> None:
    """``tokenizer.json`` says what its tokens are, whatever model the text encoder is of."""
    trained = POLICIES / "vla" / "trained" / "multi_task_dit"
    with np.load(trained / "answers.npz", allow_pickle=False) as file:
        text, rows = str(file["instruction"][5]), file["observation.language.tokens"][5]
        mask = file["observation.language.attention_mask"][5]
    module, _ = load_checkpoint_policy(trained / "policy", options=LoadOptions(task=text))
    encoder: Any = module.get_submodule("encoder")
    assert encoder.task_tokens.tolist() == [rows[mask].tolist()]


def test_encoders_that_are_kept_elsewhere_are_named_to_the_rival_too(tmp_path: Path) -> None:
    policy = POLICIES / "pixels" / "policy"
    spec = load_checkpoint_policy(policy)[1]
    shutil.copytree(policy, tmp_path / "policy", ignore=lambda folder, names: ["clip-tiny"])
    with pytest.raises(CheckpointError, match="--encoders"):
        original_policy(tmp_path / "policy", spec)
    _, original = original_policy(tmp_path / "policy", spec, policy / "clip-tiny")
    assert original.observations.keys() == spec.observations.keys()


def test_keypoints_under_lerobots_name() -> None:
    environment = PushT()
    environment.reset(seed=5)
    np.testing.assert_array_equal(environment.observe()["observation.state"], observation(environment.state))


def test_pictures_of_demonstrations_are_what_the_environment_shows(tmp_path: Path) -> None:
    environment, states, seen = PushTPixels(), [], []
    for seed in range(3):
        environment.reset(seed)
        states.append(environment.state)
        seen.append(environment.observe()["observation.image"])
    np.savez(tmp_path / "demonstrations.npz", state=np.array(states, np.float32))
    script, out = POLICIES / "pixels" / "pictures.py", tmp_path / "pictures.npz"
    command = [sys.executable, str(script), str(tmp_path / "demonstrations.npz"), "-o", str(out), "--drawn", "5"]
    subprocess.run(command, check=True, timeout=120)
    with np.load(out, allow_pickle=False) as file:
        assert file["drawn"].shape == (5, 64, 64, 3)
        assert len({picture.tobytes() for picture in file["drawn"]}) == 5
        assert file["states"].shape == (5, 5)
        drawn = np.moveaxis(file["demonstrated"], -1, 1).astype(np.float32) / 255
    differing = (np.abs(drawn - np.stack(seen)) > 0).any(axis=1).mean()
    assert differing < 0.001, "a state in float32 draws the same picture, but for a rounded corner"
