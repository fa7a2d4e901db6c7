"""Parity with openpi's pi0 and pi0.5 at tiny sizes: from a robot's images, state and words to its actions."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import ttscompile
from tests.once import Once
from ttscompile.core.spec import Noise
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions

from ..families.support import record
from . import openpis, originals
from .lerobot_tiny import change_json, write_json
from .refused import assert_not_read
from .vlas import Array

pytestmark = pytest.mark.filterwarnings("ignore:.*what openpi saves is compiled")


@pytest.fixture(scope="module")
def golden() -> Mapping[str, Array]:
    return originals.golden("openpi")


@pytest.fixture
def words(tmp_path: Path) -> Path:
    """Where the compiler finds the tokenizer."""
    return openpis.save_tokenizer(tmp_path)


eager, assert_same = openpis.eager, openpis.assert_same


@pytest.mark.parametrize("call", [0, 1])
@pytest.mark.parametrize("kind", openpis.KINDS)
def test_the_rebuilt_network_gives_openpis_actions(
    tmp_path: Path, words: Path, golden: Mapping[str, Array], kind: str, call: int
) -> None:
    """Two instructions, and two sizes of images, of which openpi resizes one."""
    found = eager(openpis.save(kind, tmp_path / "policy"), words, call)
    assert_same(found, golden[f"{kind}.{call}"])
    assert np.abs(found - golden[f"{kind}.{1 - call}"][..., : openpis.ACTION_DIM]).max() > 0.01


@pytest.mark.parametrize("kind", openpis.KINDS)
def test_a_camera_that_the_robot_lacks_is_masked(
    tmp_path: Path, words: Path, golden: Mapping[str, Array], kind: str
) -> None:
    options = LoadOptions(without_cameras=[openpis.ABSENT])
    found = eager(openpis.save(kind, tmp_path / "policy"), words, 0, options)
    assert_same(found, golden[f"{kind}.missing"])
    assert np.abs(found - golden[f"{kind}.0"][..., : openpis.ACTION_DIM]).max() > 0.01


@pytest.mark.parametrize("kind", ["pi0", "plain"])
def test_one_instruction_is_compiled_in(tmp_path: Path, words: Path, golden: Mapping[str, Array], kind: str) -> None:
    options = LoadOptions(task=openpis.TASKS[1], encoders=words)
    assert_same(eager(openpis.save(kind, tmp_path / "policy"), words, 1, options), golden[f"{kind}.1"])


def test_pi05_is_told_its_state_in_words_as_openpi_tells_it(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    """Numbers far outside, at the ends of ranges, and one that never moved, whose range is a millionth."""
    told = load_checkpoint_policy(openpis.save("pi05", tmp_path / "policy"))[1].instruction
    assert told is not None and told.state is not None
    lines = [told.line(openpis.TASKS[i % 2], told.state(state)) for i, state in enumerate(openpis.states())]
    assert lines == golden["lines"].tolist()


def assert_recorded(kind: str, program: Any) -> None:
    compared = "actions that openpi 15a9616 gave, raw images and words to action, 1e-4"
    record(f"openpi {kind}", compared, "euler 10", program)


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
@pytest.mark.parametrize("kind", ["pi0", "pi05", pytest.param("plain", marks=pytest.mark.soak)])
def test_what_is_compiled_gives_them_too(
    once: Once, tmp_path: Path, words: Path, golden: Mapping[str, Array], kind: str, runtime: str
) -> None:
    artifact, program = once.compiled(
        f"openpi {kind}", lambda to: ttscompile.convert(openpis.save(kind, tmp_path / "policy"), to, encoders=words)
    )
    if kind != "plain":
        assert_recorded(kind, program)
    policy = ttscompile.load(artifact, runtime=runtime)
    assert ("state" in policy.info.observation) == (kind != "plain")
    for call in (0, 1):
        seen = {**openpis.observed(call), "task": openpis.TASKS[call]}
        if kind == "plain":
            del seen["state"]
        found = policy.predict_action_chunk(seen, noise=Noise(openpis.noise()), plan="dense")
        assert_same(found, golden[f"{kind}.{call}"])


def trained(kind: str, directory: Path, notes: Any) -> Path:
    """As ``train_pytorch.py`` saves it: without a configuration, with the notes of a training in bfloat16."""
    openpis.save(kind, directory)
    (directory / "config.json").unlink()
    (directory / "metadata.pt").write_bytes(bytes(notes))
    return directory


@pytest.mark.parametrize("kind", openpis.KINDS)
def test_what_pytorchs_training_noted_is_read_and_its_rounding_kept(
    tmp_path: Path, words: Path, golden: Mapping[str, Array], kind: str
) -> None:
    """Chunk, length of the prompt, whether the state is in it; and frequencies of positions in bfloat16."""
    directory = trained(kind, tmp_path / "policy", golden[f"{kind}.notes"])
    found = eager(directory, words, 0)
    assert_same(found, golden[f"{kind}.rounded"])
    assert np.abs(found - golden[f"{kind}.0"][..., : openpis.ACTION_DIM]).max() > 5e-4
    write_json(directory / "config.json", {"action_horizon": 4})
    assert load_checkpoint_policy(directory)[1].sample[0] == 4  # what the user writes counts


class Ran:
    """Would run when it is unpickled."""

    def __reduce__(self) -> Any:
        return open, ("ran", "w")


def test_notes_are_not_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    directory = openpis.save("pi0", tmp_path / "policy", action_horizon=None)
    torch.save({"config": {"first": Ran(), "model": {"action_horizon": 3, "pi05": Ran()}}}, directory / "metadata.pt")
    assert load_checkpoint_policy(directory)[1].sample[0] == 3
    assert not (tmp_path / "ran").exists()
    content = (directory / "metadata.pt").read_bytes()
    for damaged in (content[:200], b"", content.replace(b"action_horizon", b"\xff" * 14)):
        (directory / "metadata.pt").write_bytes(damaged)
        assert_not_read(directory, "not the notes of a training of openpi's, or damaged ones", names=tmp_path)


def test_the_prompt_is_said_to_hold_the_state_where_nothing_tells(tmp_path: Path) -> None:
    directory = openpis.save("pi05", tmp_path / "policy", discrete_state_input=None)
    with pytest.warns(
        UserWarning, match=r"Your robot's own transforms .* stay outside.* Nothing here says discrete_st"
    ):
        told = load_checkpoint_policy(directory)[1].instruction
    assert told is not None and told.state is not None
    change_json(directory / "config.json", discrete_state_input=False)
    with pytest.warns(UserWarning, match="what openpi saves is compiled") as heard:
        told = load_checkpoint_policy(directory)[1].instruction
    assert told is not None and told.state is None
    assert "discrete_state_input" not in str(heard[0].message)


def test_statistics_that_were_padded_say_how_wide_the_robot_is(tmp_path: Path, words: Path) -> None:
    directory = openpis.save("pi0", tmp_path / "policy")
    before = eager(directory, words, 0)
    wide: dict[str, Any] = openpis.statistics()
    for own in wide.values():
        for name, numbers in own.items():
            own[name] = numbers + [0.0 if name in ("mean", "std") else 1e-10] * (openpis.PADDED - len(numbers))
    openpis.save_statistics(directory, **wide)
    np.testing.assert_array_equal(eager(directory, words, 0), before)


WIDE = {name: [0.5] * (openpis.PADDED + 1) for name in ("mean", "std", "q01", "q99")}


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"state": None}, r"norm_stats\.state is None; expected settings by name|state is None"),
        ({"actions": {}}, "mean is None; expected 1 to 7 finite numbers"),
        ({"state": WIDE}, r"mean is \[0\.5.*expected 1 to 7 finite numbers"),
        ({"state": {**WIDE, "mean": "hello"}}, "mean is 'hello'; expected 1 to 7 finite"),
        ({"state": {**openpis.statistics()["state"], "q99": [1.0]}}, "have several lengths; expected one"),
        (
            {"state": {**openpis.statistics()["state"], "q99": [-9.0] * 4}},
            "q99 is .*expected numbers that are not below",
        ),
        ({"actions": {**openpis.statistics()["actions"], "std": [-1.0] * 5}}, "std is .*not negative"),
    ],
)
def test_statistics_that_are_none_are_refused(tmp_path: Path, parts: dict[str, Any], message: str) -> None:
    directory = openpis.save("pi05", tmp_path / "policy")
    path = openpis.save_statistics(directory, **parts)
    assert_not_read(directory, message, names=path)


def test_statistics_of_one_data_set_are_expected(tmp_path: Path) -> None:
    directory = openpis.save("pi0", tmp_path / "policy")
    openpis.save_statistics(directory, "trossen")
    told = "expected the statistics of one data set, assets/NAME/norm_stats.json; found"
    assert_not_read(directory, f"{told} {openpis.SET}, trossen. Copy the folder without the others", names=directory)
    shutil.rmtree(directory / "assets")
    assert_not_read(directory, f"{told} none. .* with the folder assets of the training", names=directory)
    openpis.save_statistics(directory).write_text("[1, 2")
    assert_not_read(directory, "cannot be read as JSON")


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (
            {"action_horizon": None},
            "config.json: action_horizon is None; expected a positive whole number.* Write there",
        ),
        ({"action_horizon": 10**9}, "4096 at most"),
        ({"action_dim": 8}, "action_in_proj.weight has shape"),
        ({"max_token_len": 0}, "max_token_len is 0; expected a positive whole number"),
        ({"pi05": True}, "pi05 is True; expected false, which the weights say"),
        (
            {"paligemma_variant": "gemma_2b_lora"},
            "converter leaves out what LoRA learned.* Give the folder that it conv",
        ),
    ],
)
def test_what_the_configuration_says_has_to_be_so(tmp_path: Path, entries: dict[str, Any], message: str) -> None:
    directory = openpis.save("pi0", tmp_path / "policy", **entries)
    assert_not_read(directory, message, names=directory)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("pi05", {"task": "go"}, "a pi05 policy reads its state as part of the instruction"),
        ("pi0", {"without_cameras": ["wrist"]}, "the cameras are base_0_rgb, .*; wrist cannot be left out"),
        ("pi0", {"without_cameras": openpis.CAMERAS}, "all cannot be left out"),
        ("pi0", {"base": "somewhere"}, "base is for policies of .*; this is one of openpi"),
    ],
)
def test_what_cannot_be_asked_for(tmp_path: Path, kind: str, options: dict[str, Any], message: str) -> None:
    directory = openpis.save(kind, tmp_path / "policy")
    assert_not_read(directory, message, names=directory, options=LoadOptions(**options))


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    directory = openpis.save("pi0", tmp_path / "policy")
    path, whole = directory / "model.safetensors", openpis.weights("pi0")
    for left_out, message in (
        ("k_proj", "k_proj.weight is missing"),
        ("action_in_proj", "the policy is pi0_fast: autoregressive over codes of actions. There is no denoising loop"),
        ("action_time_mlp", "expected the weights of openpi's pi0 or pi0.5; found action_in_proj.bias"),
    ):
        path.unlink()
        save_file({name: value for name, value in whole.items() if left_out not in name}, path)
        assert_not_read(directory, message, names=directory)
    path.unlink()
    assert_not_read(directory, "model.safetensors: no such file", names=directory)
