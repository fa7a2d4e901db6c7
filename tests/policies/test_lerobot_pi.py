"""Parity with LeRobot 0.6.1's pi0 and pi0.5 at tiny sizes: from raw images, state and tokens to robot actions."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from safetensors.torch import load_file, save_file

import ttscompile
from tests.once import Once
from tests.word_tokenizer import write_tokenizer
from ttscompile.cli import main
from ttscompile.core.spec import Noise
from ttscompile.errors import ObservationError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import AS_SAVED, LoadOptions
from ttscompile.ir.program import Program
from ttscompile.policies.lerobot.files import files_beside

from ..families.support import record
from . import originals, pis
from .lerobot_tiny import change_json, write_json
from .refused import assert_not_read
from .vlas import CAMERAS, MASK, STATE, TOKENS, Array, as_given


@pytest.fixture(scope="module")
def golden() -> Mapping[str, Array]:
    return originals.golden("lerobot_pi")


@pytest.fixture(scope="module", params=pis.KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def directory(kind: str, tmp_path: Path) -> Path:
    return pis.save(kind, tmp_path / "policy")


def eager(directory: Path, call: int, options: LoadOptions = AS_SAVED) -> Array:
    """The whole chunk of the rebuilt network, not compiled."""
    module, spec = load_checkpoint_policy(directory, options=options)
    given = pis.observation(call)
    obs = {key: torch.from_numpy(as_given(key, given, spec)) for key in spec.observations}
    return spec.chunk.unnormalized(eager_policy(module, spec)(obs, Noise(pis.noise())).numpy())


def test_what_lerobot_rounds_in_bfloat16_is_rounded(kind: str, golden: Mapping[str, Array], tmp_path: Path) -> None:
    """Frequencies of positions, and the scale of words: it casts them, and trains with them so. All else is float32."""
    found = eager(pis.save(kind, tmp_path / "policy", "bfloat16"), 0)
    assert np.abs(found - golden[f"{kind}.rounded"]).max() < 1e-5
    assert np.abs(found - golden[f"{kind}.0"]).max() > 1e-4


@pytest.mark.parametrize("mode", ["MEAN_STD", "QUANTILES"])
def test_pi05_is_told_its_state_in_words_as_lerobot_tells_it(
    golden: Mapping[str, Array], tmp_path: Path, mode: str
) -> None:
    """Numbers far outside and at the ends of ranges; a task with signs that lerobot replaces."""
    directory = pis.save("pi05", tmp_path / "policy", prompt=True)
    steps = json.loads((directory / "policy_preprocessor.json").read_text())["steps"]
    steps[0]["config"]["norm_map"]["STATE"] = mode
    change_json(directory / "policy_preprocessor.json", steps=steps)
    told = load_checkpoint_policy(directory)[1].instruction
    assert told is not None and told.state is not None and told.state.key == STATE
    lines = [told.line(pis.TASKS[i % 2], told.state(state)) for i, state in enumerate(pis.states())]
    assert lines == golden[f"pi05.prompts.{mode}"].tolist()


@pytest.mark.slow
def test_convert_says_where_a_policy_takes_no_text(tmp_path: Path) -> None:
    directory = pis.save("pi0", tmp_path / "policy")
    told = CliRunner().invoke(
        main, ["convert", str(directory), "-o", str(tmp_path / "compiled")], catch_exceptions=False
    )
    assert "hint: an observation has tokens in place of text, since the artifact has no tokenizer: that" in told.stderr
    assert "--encoders DIR" in told.stderr


@pytest.mark.slow
def test_pi05_takes_its_task_as_text(tmp_path: Path) -> None:
    """What it answers is what it answers to the tokens of the whole line; in LeRobot's commands, too."""
    directory = pis.save("pi05", tmp_path / "policy", prompt=True)
    change_json(directory / "config.json", tokenizer_max_length=24)
    words = ["?", "Task:", "Push", "the", "block,", "State:", "Action:", "\n", "128;", "128", "0", "0;"]
    write_tokenizer(tmp_path / "words", {word: number for number, word in enumerate(words)})
    ttscompile.convert(directory, tmp_path / "compiled", encoders=tmp_path / "words")
    config = json.loads((tmp_path / "compiled" / "config.json").read_text())
    assert STATE in config["input_features"]
    policy, given = ttscompile.load(tmp_path / "compiled"), pis.observation(0)
    state = np.stack([pis.states()[4], pis.states()[0]])
    frames = {key: np.repeat(given[key], 2, 0)[:, None] for key in CAMERAS} | {STATE: state[:, None]}
    noise = Noise(np.repeat(pis.noise(), 2, 0))
    in_words = policy.predict_action(frames | {"task": "Push_the block"}, noise=noise)["action"]
    line = [1, 2, 3, 4, 5, 9, 9, 9, 8, 7, 6]
    tokens, mask = np.zeros((2, 24), np.int64), np.zeros((2, 24), bool)
    tokens[:, : len(line)], mask[:, : len(line)] = line, True
    tokens[1, 5:9] = 0  # whose numbers are no words here
    policy.reset()
    np.testing.assert_array_equal(
        policy.predict_action(frames | {TOKENS: tokens, MASK: mask}, noise=noise)["action"], in_words
    )
    assert np.abs(in_words[0] - in_words[1]).max() > 1e-3
    cut = policy.with_tokens({STATE: state[0], "task": "the " * 40})
    assert cut[TOKENS].tolist() == [1, *[3] * 23] and cut[MASK].all()  # as lerobot's tokenizer does it
    frame = policy.with_tokens({STATE: state[0], "task": "Push_the block"})
    np.testing.assert_array_equal(frame[TOKENS], tokens[0])
    for wrong, why in (
        ({}, f"the task comes without '{STATE}'"),
        ({STATE: state[:, :3]}, r"float32 \[2, 3\]; expected"),
    ):
        obs = {key: frames[key] for key in CAMERAS} | wrong | {"task": "go"}
        with pytest.raises(ObservationError, match=why):
            policy.predict_action(obs)


@pytest.mark.parametrize("call", [0, 1])
def test_the_rebuilt_network_gives_lerobots_actions(
    directory: Path, kind: str, golden: Mapping[str, Array], call: int
) -> None:
    """Two instructions of other lengths, and two image sizes."""
    found = eager(directory, call)
    assert np.abs(found - golden[f"{kind}.{call}"]).max() < 1e-4
    assert np.abs(found - golden[f"{kind}.{1 - call}"]).max() > 0.01


def test_a_camera_that_the_robot_lacks(directory: Path, kind: str, golden: Mapping[str, Array]) -> None:
    found = eager(directory, 0, LoadOptions(without_cameras=[CAMERAS[1]]))
    assert np.abs(found - golden[f"{kind}.missing"]).max() < 1e-4
    assert np.abs(found - golden[f"{kind}.0"]).max() > 0.01


@pytest.mark.parametrize("width", [pis.PADDED, 2])
def test_a_policy_that_was_fine_tuned_from_a_base(
    directory: Path, kind: str, golden: Mapping[str, Array], width: int
) -> None:
    """Its configuration keeps the width of the base's state; the robot's is that of the statistics."""
    inputs = json.loads((directory / "config.json").read_text())["input_features"]
    change_json(directory / "config.json", input_features={**inputs, STATE: {"type": "STATE", "shape": [width]}})
    spec = load_checkpoint_policy(directory)[1]
    if kind == "pi0":
        assert spec.observations[STATE].shape == (1, pis.STATE_DIM)
        told = json.loads(files_beside(directory, spec)["config.json"])["input_features"]
        assert told[STATE]["shape"] == [pis.STATE_DIM]
    assert np.abs(eager(directory, 0) - golden[f"{kind}.0"]).max() < 1e-4
    steps = json.loads((directory / "policy_preprocessor.json").read_text())["steps"]
    steps[0]["config"]["norm_map"]["STATE"] = "IDENTITY"
    change_json(directory / "policy_preprocessor.json", steps=steps)
    spec = load_checkpoint_policy(directory)[1]
    assert kind == "pi05" or spec.observations[STATE].shape == (1, pis.STATE_DIM)


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
@pytest.mark.parametrize("kind", [pytest.param(kind, marks=pytest.mark.soak) for kind in ("pi05", "pi0")])
def test_what_is_compiled_gives_them_too(
    once: Once, tmp_path: Path, kind: str, golden: Mapping[str, Array], runtime: str
) -> None:
    artifact, program = once.compiled(
        f"whole {kind}", lambda to: ttscompile.convert(pis.save(kind, tmp_path / "policy"), to)
    )
    assert_recorded(kind, program)
    policy = ttscompile.load(artifact, runtime=runtime)
    assert set(policy.info.observation) == {*CAMERAS, TOKENS, MASK} | ({STATE} if kind == "pi0" else set())
    for call in (0, 1):
        found = policy.predict_action_chunk(pis.observation(call), noise=Noise(pis.noise()), plan="dense")
        assert found.shape == (1, 4, pis.ACTION_DIM)
        assert np.abs(found - golden[f"{kind}.{call}"][:, :4]).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("call", [0, 1])
@pytest.mark.parametrize(("value", "message"), [(200.0, "Divide by 255"), (np.inf, "must be finite")])
def test_images_are_checked_before_they_are_resized(
    once: Once, tmp_path: Path, call: int, value: float, message: str
) -> None:
    """Of the second call's images the size is another."""
    artifact, _ = once.compiled("whole pi05", lambda to: ttscompile.convert(pis.save("pi05", tmp_path / "policy"), to))
    policy, observed = ttscompile.load(artifact), pis.observation(call)
    observed[CAMERAS[0]][0, 0, 3, 3] = value
    frames = {key: spec.frames for key, spec in policy.info.observation.items()}
    given = {key: observed[key] if count is None else observed[key][:, None] for key, count in frames.items()}
    with pytest.raises(ObservationError, match=f"observation '{CAMERAS[0]}' .*{message}"):
        policy.predict_action(given)


def test_the_tokenizer_beside_a_policy_that_is_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(pis.save("pi0", tmp_path / "policy"))
    write_json(tmp_path / "config.json", {"model_type": "paligemma"})
    (tmp_path / "tokenizer.json").write_text("no tokenizer")
    assert_not_read(Path(), r"tokenizer\.json", names=tmp_path / "tokenizer.json", options=LoadOptions(task="go"))


def assert_recorded(kind: str, program: Program) -> None:
    record(
        f"LeRobot {kind}",
        "actions that lerobot 0.6.1 gave, raw images and tokens to action, also relative to the state, 1e-4",
        "euler 4",
        program,
    )


def test_other_names_of_the_same_weights(tmp_path: Path) -> None:
    """As openpi's converter has them, and transformers 4; and the head in place of the embedding."""
    directory = pis.save("pi0", tmp_path / "policy")
    before, path = eager(directory, 0), directory / "model.safetensors"
    renamed = {}
    for name, value in load_file(path).items():
        name = name.removeprefix("model.").replace(".vision_tower.", ".vision_tower.vision_model.")
        renamed[name.replace(".model.language_model.embed_tokens.", ".lm_head.")] = value
    path.unlink()
    save_file(renamed, path)
    assert np.array_equal(eager(directory, 0), before)


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    directory = pis.save("pi05", tmp_path / "policy")
    assert_not_read(directory, "reads its state as part of the instruction", options=LoadOptions(task="go"))
    change_json(directory / "config.json", use_relative_actions=True)
    assert_not_read(directory, "use_relative_actions")
    change_json(directory / "config.json", use_relative_actions=False)
    load_checkpoint_policy(directory)
    change_json(directory / "config.json", image_resolution=[28, 42])
    assert_not_read(directory, r"image_resolution.*a square")
    path = directory / "model.safetensors"
    weights = load_file(path)
    path.unlink()
    save_file({name: value for name, value in weights.items() if "k_proj" not in name}, path)
    change_json(directory / "config.json", image_resolution=[28, 28])
    assert_not_read(directory, "k_proj.weight is missing")
