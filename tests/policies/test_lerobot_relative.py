"""Parity with LeRobot's policies whose actions are relative to the state, at tiny sizes: raw observation to actions."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.once import Once
from ttscompile.core.spec import Noise, Relative
from ttscompile.errors import ObservationError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.examined import examine
from ttscompile.frontends.families import AS_SAVED

from . import eefs, groots, originals, pis, relatives, vla_jepas
from .lerobot_tiny import change_json
from .originals import assert_agreement_on_random_plans
from .refused import Refusals, assert_not_read, refusals
from .vlas import STATE, Array
from .whole_vlas import eager_chunk

KINDS = ("pi0", "pi05", "groot", "vla_jepa")
ENTRIES = {
    "pi0": (0, 1, None, 3, None),
    "pi05": (0, 1, None, 3, None),
    "groot": (3, 0, 1, 2, None),
    "vla_jepa": (0, 1, 2, 3, 4, 5, None),
}
NOISE = {"groot": groots.noise, "vla_jepa": vla_jepas.noise}
TOKENIZERS = {
    "groot": (groots.SAVED / "native" / groots.BACKBONE, groots.TASKS),
    "vla_jepa": (vla_jepas.SAVED / "libero" / vla_jepas.BACKBONE, vla_jepas.TASKS),
}


@pytest.fixture(scope="module")
def golden() -> Mapping[str, Array]:
    return originals.golden("lerobot_relative")


@pytest.mark.parametrize("kind", KINDS)
def test_the_rebuilt_network_gives_lerobots_actions(tmp_path: Path, kind: str, golden: Mapping[str, Array]) -> None:
    """In two states; some numbers of the actions are absolute."""
    directory = relatives.save(kind, tmp_path)
    relative = load_checkpoint_policy(directory)[1].chunk.relative
    assert relative == Relative(STATE, ENTRIES[kind])
    for call in (0, 1):
        folder, tasks = TOKENIZERS.get(kind, (Path(), ("", "")))
        given, noise = relatives.observation(kind, call), NOISE.get(kind, pis.noise)()
        chunk, found = eager_chunk(directory, AS_SAVED, given, noise, folder, tasks[call])
        expected = golden[f"{kind}.{call}"]
        found = found[:, chunk.start : chunk.start + expected.shape[1]]
        assert np.abs(found - expected).max() < 1e-4
        added = np.array([0 if entry is None else given[STATE][entry] for entry in relative.entries])
        assert np.abs(found - added - expected).max() > 0.5  # nor is it the difference


def compiled(once: Once, tmp_path: Path, kind: str) -> Path:
    return once.compiled(f"relative {kind}", lambda to: ttscompile.convert(relatives.save(kind, tmp_path / "in"), to))[
        0
    ]


def given_to(kind: str, call: int, windows: bool = False) -> dict[str, Any]:
    own: dict[str, Any] = {key: value[None] for key, value in relatives.observation(kind, call).items()}
    if windows:
        own = {key: value if "language" in key else value[:, None] for key, value in own.items()}
    return own | ({"task": TOKENIZERS[kind][1][call]} if kind in TOKENIZERS else {})


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
@pytest.mark.parametrize(
    "kind", ["pi05", "groot", *(pytest.param(kind, marks=pytest.mark.soak) for kind in KINDS[::3])]
)
def test_what_is_compiled_gives_them_too(
    once: Once, tmp_path: Path, kind: str, golden: Mapping[str, Array], runtime: str
) -> None:
    tokenizer = TOKENIZERS[kind][0] if kind in TOKENIZERS else None
    policy = ttscompile.load(compiled(once, tmp_path, kind), runtime=runtime, tokenizer=tokenizer)
    for call in (0, 1):
        noise = Noise(NOISE.get(kind, pis.noise)())
        found = policy.predict_action_chunk(given_to(kind, call), noise=noise, plan="dense")
        assert np.abs(found - golden[f"{kind}.{call}"][:, : found.shape[1]]).max() < 1e-4
        if kind == "pi05":
            out = policy.predict_action(given_to(kind, call, windows=True), noise, "dense")["action_pred"]
            assert np.abs(out - golden[f"{kind}.{call}"]).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_a_prefix_is_of_the_robots_own_actions(
    once: Once, tmp_path: Path, golden: Mapping[str, Array], runtime: str
) -> None:
    """As lerobot's rollout does it: less the state of the call that goes on from it, and then normalised."""
    policy = ttscompile.load(compiled(once, tmp_path, "pi05"), runtime=runtime)
    given, noise, prefix = given_to("pi05", 0, windows=True), Noise(pis.noise()), relatives.committed()
    for delay in range(1, pis.TRAINED + 1):
        found = policy.predict_action(given, noise, "dense", prefix[:, :delay])["action_pred"]
        assert np.abs(found - golden[f"pi05.prefix.{delay}"]).max() < 1e-4
        assert np.abs(found[:, :delay] - prefix[:, :delay]).max() < 1e-5
    with pytest.raises(ObservationError, match="prefix, less the observation, must be between"):
        policy.predict_action(given, noise, "dense", np.float32(1e7) + prefix)


@pytest.mark.slow
def test_a_single_file_and_a_module_add_the_state_too(once: Once, tmp_path: Path, golden: Mapping[str, Array]) -> None:
    """And every rung of verify holds; plans of all kinds are the reference's."""
    artifact = compiled(once, tmp_path, "pi05")
    assert ttscompile.verify(artifact, calls=1).passed
    assert_agreement_on_random_plans(artifact, "onnxruntime")
    assert set(ttscompile.load(artifact).info.observation) >= {STATE}


def test_doctor_judges_a_range_for_each_step(tmp_path: Path) -> None:
    directory = relatives.save("groot", tmp_path)
    found = {one.what: one for one in examine(directory, load_checkpoint_policy(directory)[1])}
    assert "range of 5 numbers" in found["normaliser of action"].found


def test_steps_that_leave_actions_as_they_are(tmp_path: Path) -> None:
    """All joints are absolute, or none has a name that says so."""
    directory = relatives.with_wide_state(pis.save("pi0", tmp_path / "policy"), "pi0")
    relatives.with_relative_steps(directory, ["Arm", "arm", "ARM.pos", "left arm", "arms"], ["", "arm"])
    assert load_checkpoint_policy(directory)[1].chunk.relative is None
    for names, excluded, expected in (
        (None, ["gripper"], (0, 1, 2, 3, 4)),
        (["a", "gripper"], ["gripper"], (0, None, 2, 3, 4)),
        (["a", "gripper"], [], (0, 1, 2, 3, 4)),
    ):
        first, _ = relatives.pipelines(directory)
        steps = json.loads(first.read_text())["steps"]
        steps[0]["config"] |= {"action_names": names, "exclude_joints": excluded}
        change_json(first, steps=steps)
        relative = load_checkpoint_policy(directory)[1].chunk.relative
        assert relative is not None
        assert relative.entries == expected


@pytest.mark.parametrize(
    ("first", "second", "config", "message"),
    [
        ({"enabled": False}, {}, {}, "both enabled or none; found .*enabled: .False, True"),
        ({}, {"enabled": False}, {}, "both enabled or none"),
        ({"enabled": False}, {"enabled": False}, {}, "use_relative_actions is set, and no step around the policy adds"),
        ({"enabled": "yes"}, {}, {}, "enabled is 'yes'; expected true or false"),
        ({"action_names": "arm"}, {}, {}, "expected names in action_names and exclude_joints"),
        ({"exclude_joints": [1]}, {}, {}, "expected names in action_names and exclude_joints"),
        ({"last": True}, {}, {}, "expected relative_actions_processor before the state is changed"),
        ({}, {"first": True}, {}, "expected absolute_actions_processor after actions are unnormalised"),
        ({}, {}, {"adapt_to_pi_aloha": True}, "adapt_to_pi_aloha is set: lerobot turns joints into others that are"),
    ],
)
def test_steps_that_are_no_pair_are_refused(
    tmp_path: Path, first: dict[str, Any], second: dict[str, Any], config: dict[str, Any], message: str
) -> None:
    directory = relatives.save("pi0", tmp_path)
    change_json(directory / "config.json", **config)
    for path, name, changes in zip(
        relatives.pipelines(directory), (relatives.RELATIVE, relatives.ABSOLUTE), (first, second), strict=True
    ):
        steps = json.loads(path.read_text())["steps"]
        (own,) = (step for step in steps if step["registry_name"] == name)
        own["config"] |= {key: value for key, value in changes.items() if key not in ("first", "last")}
        if "last" in changes or "first" in changes:
            steps.remove(own)
            steps.insert(0 if "first" in changes else len(steps), own)
        change_json(path, steps=steps)
    assert_not_read(directory, message)


def test_a_state_that_is_shorter_than_an_action(tmp_path: Path) -> None:
    directory = relatives.with_relative_steps(pis.save("pi0", tmp_path / "policy"), None)
    assert_not_read(directory, "the 5 numbers of an action are relative to a state, which has 4; expected as many")


def test_a_state_of_one_number_is_added_to_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As lerobot's step does it, but to those that are absolute."""
    monkeypatch.setitem(relatives.STATE_DIMS, "pi0", 1)
    directory = relatives.with_wide_state(pis.save("pi0", tmp_path / "policy"), "pi0")
    relatives.with_relative_steps(directory, list(relatives.NAMES))
    relative = load_checkpoint_policy(directory)[1].chunk.relative
    assert relative is not None
    assert relative.entries == (0, 0, None, 0, None)


def test_a_gripper_of_two_values_has_to_be_absolute(tmp_path: Path) -> None:
    directory = relatives.with_wide_state(vla_jepas.save("libero", tmp_path), "vla_jepa")
    relatives.with_relative_steps(directory, None)
    assert_not_read(directory, "number 6 of an action is relative to the state, and then made one of two")


GROUPS: Refusals = {
    "groot": [
        ({"type": "EEF", "format": "XYZ_ROT6D"}, "have 3 numbers, and the state 'arm' 3; expected 9 each, as EEF"),
        ({"state_key": "leg"}, "ValueError.*leg.*; expected groups of an action"),
        ({"state_key": "gripper"}, "actions 'reach' have 3 numbers, and the state 'gripper' 1"),
    ],
    "groot eef": [
        ({"format": "XYZ_ROTVEC"}, r"'eef_9d' are relative, as EEF of the format XYZ_ROTVEC, which is not decoded"),
        ({"format": "DEFAULT"}, "expected NON_EEF, or EEF of the format XYZ_ROT6D"),
        ({"type": "HAND"}, "as HAND of the format XYZ_ROT6D, which is not decoded"),
        ({"state_key": "joint_position"}, "'eef_9d' have 9 numbers, and the state 'joint_position' 2; expected 9 each"),
    ],
}


def save_groups(kind: str, folder: Path, changes: dict[str, Any]) -> Path:
    """A policy of GR00T's with changes to its second group of actions, which is relative."""
    directory = eefs.save("arm", folder) if kind == "groot eef" else relatives.save(kind, folder)
    relatives.change_group(directory, 1, changes)
    return directory


@pytest.mark.parametrize(("kind", "changes", "message"), refusals(GROUPS))
def test_groups_that_are_not_rebuilt_are_named(
    tmp_path: Path, kind: str, changes: dict[str, Any], message: str
) -> None:
    assert_not_read(save_groups(kind, tmp_path, changes), message)


def test_other_ways_to_say_what_groups_are(tmp_path: Path) -> None:
    """One that is absolute after all; and small letters."""
    chunk = load_checkpoint_policy(save_groups("groot", tmp_path / "absolute", {"rep": "ABSOLUTE"}))[1].chunk
    assert chunk.relative == Relative(STATE, (3, None, None, None, None))
    assert chunk.normalizer is not None
    assert chunk.normalizer.scale.shape == (5,)
    expected = load_checkpoint_policy(eefs.save("arm", tmp_path / "arm"))[1].chunk.relative
    small = {"format": "xyz+rot6d", "type": "eef", "rep": "relative"}
    assert load_checkpoint_policy(save_groups("groot eef", tmp_path / "small", small))[1].chunk.relative == expected


def test_the_state_is_added_once(tmp_path: Path) -> None:
    """By groups of the base's, or by the steps of all policies."""
    directory = relatives.save("groot", tmp_path)
    config = json.loads((directory / "config.json").read_text())
    wide = {STATE: {"type": "STATE", "shape": [groots.ACTION_DIM]}}
    change_json(directory / "config.json", input_features=config["input_features"] | wide)
    none = {"enabled": True, "exclude_joints": [], "action_names": None}
    pair = ((relatives.RELATIVE, none, 2), (relatives.ABSOLUTE, {"enabled": True}, 1))
    for path, (name, own, place) in zip(relatives.pipelines(directory), pair, strict=True):
        steps = json.loads(path.read_text())["steps"]
        steps.insert(place, {"registry_name": name, "config": own})
        for step in steps:
            step["config"] |= {"normalize_min_max": False} if "pack" in step["registry_name"] else {}
        change_json(path, steps=steps)
    assert_not_read(directory, "groot_n1_7_action_decode_v1 and the steps after it add the state")
