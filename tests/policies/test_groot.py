"""Parity with NVIDIA's GR00T N1.7 at tiny sizes: from raw pictures, state and instruction to robot actions."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.once import Once
from ttscompile.core.spec import Noise
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.examined import examine
from ttscompile.frontends.families import LoadOptions, function_of
from ttscompile.policies.opencv_area import area_resized

from ..families.support import record
from . import isaac_groots as own, originals
from .lerobot_tiny import change_json
from .refused import Refusals, assert_not_read, refusals
from .vlas import MASK, TOKENS, Array
from .whole_vlas import assert_refused

pytestmark = pytest.mark.filterwarnings("ignore:.*pictures that are no squares")
TAG = own.TAGS["still"]


@pytest.fixture(scope="module")
def golden() -> Mapping[str, Array]:
    return originals.golden("groot")


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """The smallest policy."""
    return own.save("still", tmp_path, 0)


@pytest.mark.parametrize("compiled_in", [False, True])
@pytest.mark.parametrize("kind", own.KINDS)
def test_the_rebuilt_network_gives_nvidias_actions(
    tmp_path: Path, golden: Mapping[str, Array], kind: str, compiled_in: bool
) -> None:
    """Two instructions, and pictures of two sizes; actions relative to a pose, to joints, and of deviations."""
    for call in (0, 1):
        directory = own.save(kind, tmp_path / str(call), call)
        found = own.eager(directory, kind, call, LoadOptions(task=own.TASKS[call] if compiled_in else None))
        expected = golden[f"{kind}.{call}"]
        assert np.abs(found[:, : own.STEPS[kind]] - expected).max() < 2e-6
        assert np.abs(golden[f"{kind}.{1 - call}"] - expected).max() > 0.005


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
@pytest.mark.parametrize("kind", ["droid", pytest.param("still", marks=pytest.mark.soak)])
def test_what_is_compiled_gives_them_too(
    once: Once, tmp_path: Path, golden: Mapping[str, Array], kind: str, runtime: str
) -> None:
    artifact, program = once.compiled(f"groot {kind}", lambda to: ttscompile.convert(own.save(kind, tmp_path, 0), to))
    if kind == "droid":
        compared = "actions that Isaac-GR00T 65cc4a1 gave, raw pictures, state and words to action, 1e-4"
        record("GR00T N1.7, whole, read from its directory", compared, "euler 4", program)
    policy = ttscompile.load(artifact, runtime=runtime)
    assert set(policy.info.observation) == {"state", *(f"video.{key}" for key in own.CAMERAS[kind]), TOKENS, MASK}
    given = {key: value[None] for key, value in own.observation(kind, 0).items()} | {"task": own.TASKS[0]}
    found = policy.predict_action(given, noise=Noise(own.noise()), plan="dense")["action"]
    assert found.shape == golden[f"{kind}.0"].shape
    assert np.abs(found - golden[f"{kind}.0"]).max() < 1e-4
    if runtime == "onnxruntime":
        assert ttscompile.verify(artifact, calls=1).passed


def test_what_a_robot_gives_and_gets(tmp_path: Path) -> None:
    _, spec = load_checkpoint_policy(own.save("droid", tmp_path / "droid", 0))
    seen = {key: (one.shape, one.frames) for key, one in spec.observations.items()}
    # Two frames that are fifteen steps apart are no window of the last ones.
    assert seen["video.out"] == seen["video.wrist"] == ((2, 3, 32, 32), None)
    assert seen["state"] == ((1, 12), 1)
    parts = "eef_9d 9, gripper 1, joints 2"
    told = {"format": "groot", "policy": "GR00T N1.7", "embodiment": own.TAGS["droid"]}
    assert dict(spec.source) == {**told, "state": parts, "action": parts}
    assert (spec.chunk.start, spec.chunk.stop, spec.chunk.action_dim) == (0, 6, 12)
    _, spec = load_checkpoint_policy(own.save("still", tmp_path / "still", 0))
    assert (spec.observations["video.image"].shape, spec.observations["video.image"].frames) == ((2, 3, 48, 64), 2)
    assert (spec.chunk.stop, spec.sample) == (5, (6, own.PADDED))


def test_pictures_are_squares_of_the_shorter_side_unless_it_is_told(tmp_path: Path) -> None:
    directory = own.save("droid", tmp_path, 0)
    path = directory / "config.json"
    entries = json.loads(path.read_text())
    del entries["image_size"]
    path.write_text(json.dumps(entries))
    assert load_checkpoint_policy(directory)[1].observations["video.out"].shape == (2, 3, 32, 32)
    change_json(path, image_size=[20, 30])
    with pytest.warns(UserWarning, match="pictures that are no squares keep their proportions.*letter_box_transform"):
        spec = load_checkpoint_policy(directory)[1]
    assert spec.observations["video.wrist"].shape == (2, 3, 20, 30)


def test_a_robot_is_chosen_where_there_are_several(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    """By an entry that the user writes; or it is the only one that the last training had."""
    directory = own.save("still", tmp_path, 0)
    processor, statistics, path = (directory / f"{name}.json" for name in ("processor_config", "statistics", "config"))
    told, numbers = json.loads(processor.read_text()), json.loads(statistics.read_text())
    modalities = told["processor_kwargs"]["modality_configs"]
    modalities["other"], numbers["other"] = modalities[TAG], numbers[TAG]
    processor.write_text(json.dumps(told))
    statistics.write_text(json.dumps(numbers))
    asked = 'has the embodiments libero_sim, other, and embodiment_tag is None. .*: "embodiment_tag": "libero_sim"'
    assert_not_read(directory, asked, names=path)
    (directory / "experiment_cfg").mkdir()
    (directory / "experiment_cfg" / "dataset_statistics.json").write_text(json.dumps({TAG: {}}))
    assert np.abs(own.eager(directory, "still", 0)[:, :5] - golden["still.0"]).max() < 2e-6
    change_json(path, embodiment_tag="other")
    assert_not_read(directory, "embodiment_id.json: other is None; expected the number of its weights")
    change_json(directory / "embodiment_id.json", other=1)
    assert load_checkpoint_policy(directory)[1].source["embodiment"] == "other"
    assert np.abs(own.eager(directory, "still", 0)[:, :5] - golden["still.0"]).max() > 1e-3
    change_json(path, embodiment_tag="nobody")
    assert_not_read(directory, "embodiment_tag is 'nobody'")


def test_an_embodiment_without_a_table_has_the_number_that_the_code_gives_it(directory: Path) -> None:
    (directory / "embodiment_id.json").unlink()
    first = own.eager(directory, "still", 0)
    (directory / "embodiment_id.json").write_text(json.dumps({TAG: 2}))
    np.testing.assert_array_equal(own.eager(directory, "still", 0), first)


def test_what_a_training_left_in_a_folder_of_its_own_is_found(directory: Path, golden: Mapping[str, Array]) -> None:
    (directory / "processor").mkdir()
    for name in ("processor_config.json", "statistics.json", "embodiment_id.json"):
        (directory / name).rename(directory / "processor" / name)
    assert np.abs(own.eager(directory, "still", 0)[:, :5] - golden["still.0"]).max() < 2e-6


def test_a_camera_that_the_robot_lacks_is_left_out_of_the_prompt(tmp_path: Path) -> None:
    """As where the code's own list of cameras is without it."""
    directory = own.save("arm", tmp_path, 0)
    found = own.eager(directory, "arm", 0, LoadOptions(without_cameras=["video.wrist"]))
    path = directory / "processor_config.json"
    told = json.loads(path.read_text())
    told["processor_kwargs"]["modality_configs"][own.TAGS["arm"]]["video"]["modality_keys"] = ["front"]
    path.write_text(json.dumps(told))
    change_json(directory / "config.json", image_size=[24, 40])
    np.testing.assert_array_equal(own.eager(directory, "arm", 0), found)


def test_a_state_that_is_excluded_is_not_seen(directory: Path) -> None:
    path = directory / "processor_config.json"
    told = json.loads(path.read_text())
    told["processor_kwargs"]["exclude_state"] = True
    path.write_text(json.dumps(told))
    module, _ = load_checkpoint_policy(directory, options=LoadOptions(task="go"))
    noise, seen = torch.from_numpy(own.noise()), own.observation("still", 0)
    given = {key.replace(".", "_"): torch.from_numpy(value)[None] for key, value in seen.items()}
    with torch.no_grad():
        first, other = (module(noise, torch.tensor([0]), **given | {"state": given["state"] + i}) for i in (0, 1))
    assert torch.equal(first, other)


def test_pictures_are_resized_as_opencv_does(golden: Mapping[str, Array]) -> None:
    for number, (after, picture) in enumerate(own.zooms()):
        pixels = torch.from_numpy(picture.copy()).permute(2, 0, 1).float()
        found = area_resized((picture.shape[0], picture.shape[1]), after)(pixels).permute(1, 2, 0).numpy()
        np.testing.assert_array_equal(found, golden[f"zoom.{number}"], err_msg=str((picture.shape, after)))


def test_doctor_and_the_tokenizer(directory: Path) -> None:
    spec = load_checkpoint_policy(directory)[1]
    doubts = {one.what: one.found for one in examine(directory, spec)}
    assert "always gives the same in column 2 of 3" in doubts["normaliser of action"]
    find = function_of(spec, "tokenizer_file")
    assert find is not None and find(directory, None) == directory.parent / own.BACKBONE / "tokenizer.json"


REFUSED: Refusals = {
    "config.json": [
        ({"backbone_model_type": "eagle"}, "backbone_model_type is 'eagle'; expected qwen"),
        ({"strict_action_padding_mask": True}, "strict_action_padding_mask is True; expected false"),
        ({"model_name": "nvidia/other"}, "'nvidia/other' is not on this machine"),
        ({"select_layer": 2}, "select_layer is 2; expected more than the 2 layers of deepstack"),
        ({"image_size": {"front": [8, 8]}}, r"image_size is .*; expected \[height, width\], or one for each of image"),
        ({"image_size": {"image": "x"}}, r"image_size\.image is 'x'; expected \[height, width\]"),
        ({"max_state_dim": 9}, "max_state_dim is 9; expected 17"),
    ],
    "processor_config.json": [({"processor_kwargs": 1}, "processor_kwargs is 1; expected settings by name")],
    "processor_config.json/processor_kwargs": [
        ({"use_tactile": True}, "use_tactile is True; expected false"),
        ({"max_action_dim": 2}, "max_action_dim is 14; expected 2"),
        ({"image_crop_size": None}, "crop_fraction is None; expected a share of a side"),
        ({"crop_fraction": 2}, "crop_fraction is 2; expected a share of a side"),
        ({"image_target_size": None, "crop_fraction": 1.0}, "image_target_size is None; expected height and width"),
        (
            {"use_albumentations": False, "image_crop_size": [25, 25]},
            "image_crop_size is .*; expected height and width",
        ),
    ],
    f"processor_config.json/processor_kwargs/modality_configs/{TAG}": [({"video": 0}, "video is 0; expected settings")],
    f"processor_config.json/processor_kwargs/modality_configs/{TAG}/video": [
        ({"delta_indices": []}, "delta_indices is .*; expected 1 to 64 whole numbers"),
        ({"modality_keys": []}, "modality_keys is .*; expected names"),
        ({"modality_keys": ["a", "a"]}, "modality_keys is .*; expected different names"),
    ],
    f"processor_config.json/processor_kwargs/modality_configs/{TAG}/state": [
        ({"delta_indices": [-1, 0]}, "delta_indices is .*; expected one: a state of several frames"),
        ({"modality_keys": ["x", "z"]}, "z is None; expected settings by name"),
    ],
    f"processor_config.json/processor_kwargs/modality_configs/{TAG}/action": [
        (
            {"mean_std_embedding_keys": ["x"]},
            "mean_std_embedding_keys is .*; expected all groups of an action, or none",
        ),
        ({"modality_keys": ["x", "z"]}, "KeyError.*; expected groups of an action"),
    ],
    f"statistics.json/{TAG}/action/x": [({"min": 0.0, "max": 1.0}, "IndexError.*; expected groups of an action")],
    f"statistics.json/{TAG}/state/pad": [
        ({"min": [0, "x"]}, "min is .*; expected finite numbers"),
        ({"min": [0.0]}, "its statistics have 1 and 2 numbers; expected as many"),
    ],
}


@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_not_rebuilt_is_named(directory: Path, place: str, changes: dict[str, Any], message: str) -> None:
    assert_refused(directory, place, changes, message)


def test_a_state_or_action_that_is_wider_than_the_network(tmp_path: Path) -> None:
    directory = own.save("droid", tmp_path, 0)
    for name in ("config.json", "processor_config.json/processor_kwargs"):
        assert_refused(directory, name, {"max_state_dim": 11}, "max_state_dim|has a state of 12 numbers")


def test_pictures_that_become_too_large(tmp_path: Path) -> None:
    message = "image_size is .*; expected 4096 pixels a side at most once they are resized"
    assert_refused(own.save("droid", tmp_path, 0), "config.json", {"image_size": [1, 4096]}, message)


def test_cameras_that_end_in_different_sizes(tmp_path: Path) -> None:
    sizes = {"out": [32, 32], "wrist": [32, 64]}
    assert_refused(own.save("droid", tmp_path, 0), "config.json", {"image_size": sizes}, "pictures that have one size")
