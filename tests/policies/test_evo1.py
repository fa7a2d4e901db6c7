"""Parity with Evo-1 of its authors at tiny sizes: from raw pictures, state and instruction to robot actions."""

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
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions, function_of
from ttscompile.policies.opencv_area import area_resized, linear_resized

from ..families.support import record
from . import originals, sjtu_evo1s as own
from .refused import Refusals, assert_not_read, refusals
from .vlas import MASK, TOKENS, Array
from .whole_vlas import assert_refused

CLOSE = 1e-5
"""Of actions up to 2.5."""


@pytest.fixture(scope="module")
def golden() -> Mapping[str, Array]:
    return originals.golden("evo1")


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    return own.save("quantiles", tmp_path, 0)


@pytest.mark.parametrize("compiled_in", [False, True])
@pytest.mark.parametrize("kind", own.KINDS)
def test_the_rebuilt_network_gives_their_actions(
    tmp_path: Path, golden: Mapping[str, Array], kind: str, compiled_in: bool
) -> None:
    """Two instructions, and pictures of two sizes; a camera that the robot lacks, and two."""
    task = own.TASKS[0] if compiled_in else None
    for call in (0, 1):
        directory = own.save(kind, tmp_path / str(call), call)
        found = own.eager(directory, kind, call, LoadOptions(task=task and own.TASKS[call]))
        assert np.abs(found - golden[f"{kind}.{call}"]).max() < CLOSE
        assert np.abs(golden[f"{kind}.{1 - call}"] - golden[f"{kind}.{call}"]).max() > 0.05
    for name, absent in (("missing", own.CAMERAS[2:]), ("alone", own.CAMERAS[1:])):
        found = own.eager(tmp_path / "0" / "policy", kind, 0, LoadOptions(task=task, without_cameras=absent))
        assert np.abs(found - golden[f"{kind}.{name}"]).max() < CLOSE
        assert np.abs(golden[f"{kind}.{name}"] - golden[f"{kind}.0"]).max() > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_what_is_compiled_gives_them_too(once: Once, tmp_path: Path, golden: Mapping[str, Array], runtime: str) -> None:
    """One camera is missing; the text is an observation."""

    def compiled(to: Path) -> Any:
        return ttscompile.convert(own.save("quantiles", tmp_path, 0), to, without_cameras=["image_3"])

    artifact, program = once.compiled("evo1 quantiles", compiled)
    compared = "actions that MINT-SJTU/Evo-1 1bf31c4 gave, raw pictures, state and words to action, 1e-4"
    record("Evo-1, whole, read from its directory", compared, "euler 50", program)
    policy = ttscompile.load(artifact, runtime=runtime)
    assert set(policy.info.observation) == {"state", *own.CAMERAS[:2], TOKENS, MASK}
    seen = {key: value[None] for key, value in own.observation(0).items() if key in policy.info.observation}
    given = seen | {"task": own.TASKS[0]}
    found = policy.predict_action(given, noise=Noise(own.noise("quantiles")), plan="dense")["action"]
    assert found.shape == golden["quantiles.missing"].shape
    assert np.abs(found - golden["quantiles.missing"]).max() < 1e-4
    if runtime == "onnxruntime":
        assert ttscompile.verify(artifact, calls=1).passed


def test_what_a_robot_gives_and_gets(tmp_path: Path) -> None:
    _, spec = load_checkpoint_policy(own.save("bounds", tmp_path, 1))
    seen = {key: (one.shape, one.frames) for key, one in spec.observations.items()}
    assert seen["image_1"] == ((1, 3, 60, 80), 1)
    assert seen["image_3"] == ((1, 3, 500, 471), 1)
    assert seen["state"] == ((1, own.STATE_DIM), 1)
    told = {"format": "evo1", "policy": "Evo-1", "arm": own.ARM, "dataset": own.DATASET}
    assert dict(spec.source) == told
    assert (spec.chunk.start, spec.chunk.stop, spec.chunk.action_dim) == (0, 6, own.ACTION_DIM)
    assert (spec.sample, spec.noise) == ((6, own.PADDED), "uniform")
    # Whatever the configuration says, as the server has it.
    assert spec.sampler.timesteps.tolist() == [min(int(step / 50 * 999), 999) for step in range(50)]
    _, spec = load_checkpoint_policy(tmp_path / "policy", options=LoadOptions(steps=8))
    assert (spec.sampler.steps, spec.loops["euler-8"].steps) == (50, 8)


def test_an_instruction_is_padded_to_1024_tokens(tmp_path: Path) -> None:
    """The head looks at what an instruction has too little, and at none where it has as many as there may be."""
    directory = own.save("quantiles", tmp_path, 0)
    module, spec = load_checkpoint_policy(directory)
    length, seen = spec.observations[TOKENS].shape[0], [torch.zeros(1, 3, 448, 448)] * 3
    encode = module.get_submodule("encoder.prefix")
    for words in (1, length - 1, length):
        mask = torch.arange(length)[None] < words
        context, scores = encode(seen, torch.ones(1, length, dtype=torch.int64), mask, torch.zeros(1, own.PADDED))
        assert context.shape[1] == scores.shape[1]
        padding = float(scores[0, -2])
        assert padding == pytest.approx(np.log(length - words)) if words < length else padding < -1e30
        assert float(scores[0, -1]) == 0  # of the state
        before = scores.shape[1] - 2 - length
        assert int((scores[0, :-2] == 0).sum()) == before + words


def test_pictures_are_resized_as_opencv_does(golden: Mapping[str, Array]) -> None:
    for what, pairs, way in (("linear", own.ZOOMS, linear_resized), ("area", own.MEANS, area_resized)):
        for number, (after, picture) in enumerate(own.zooms(pairs)):
            pixels = torch.from_numpy(picture.copy()).permute(2, 0, 1).float()
            found = way((picture.shape[0], picture.shape[1]), after)(pixels).permute(1, 2, 0).numpy()
            np.testing.assert_array_equal(found, golden[f"{what}.{number}"], err_msg=str((picture.shape, after)))


def test_a_robot_and_its_data_are_chosen_where_there_are_several(directory: Path) -> None:
    path = directory / "config.json"
    entries = json.loads(path.read_text())
    for name, found in (("dataset_key", "blocks, others"), ("arm_key", "another_arm, arm_ee")):
        path.write_text(json.dumps({key: value for key, value in entries.items() if key != name}))
        asked = f'norm_stats.json has {found}, and {name} is None. Write which is yours into this file: "{name}": "'
        assert_not_read(directory, asked, names=path)
    path.write_text(json.dumps(entries | {"arm_key": "another_arm", "dataset_key": None}))
    assert_not_read(directory, "norm_stats.json has x, and dataset_key is None", names=path)
    path.write_text(json.dumps(entries | {"arm_key": "another_arm", "dataset_key": "x"}))
    assert load_checkpoint_policy(directory)[1].source["dataset"] == "x"


def test_quantiles_that_are_missing_are_the_ends(directory: Path) -> None:
    path = directory / "norm_stats.json"
    found = json.loads(path.read_text())
    for part in found[own.ARM][own.DATASET].values():
        part["min"], part["max"] = part.pop("q01"), part.pop("q99")
    chunk = load_checkpoint_policy(directory)[1].chunk
    path.write_text(json.dumps(found))
    other = load_checkpoint_policy(directory)[1].chunk
    assert chunk.normalizer is not None
    assert other.normalizer is not None
    np.testing.assert_array_equal(chunk.normalizer.scale, other.normalizer.scale)
    assert (chunk.ranged, other.ranged) == (False, True)


def test_cameras_that_are_not_the_last_ones_cannot_be_missing(directory: Path) -> None:
    for absent in (["image_1"], ["image_2"]):
        with pytest.raises(CheckpointError, match="in training the first pictures were there. Leave image_3 out"):
            load_checkpoint_policy(directory, options=LoadOptions(without_cameras=absent))


def test_the_language_models_files(directory: Path) -> None:
    """The folder that transformers has comes first; its tokenizer is what the artifact keeps."""
    spec = load_checkpoint_policy(directory)[1]
    find, folder = function_of(spec, "tokenizer_file"), directory.parent / own.LANGUAGE["quantiles"]
    assert find is not None
    assert find(directory, None) == folder / "tokenizer.json"
    whole = (folder / "tokenizer.json").read_text()
    (folder / "tokenizer.json").write_text(whole.replace("<IMG_CONTEXT>", "<other>"))
    assert_not_read(directory, "tokenizer.json: <IMG_CONTEXT> has 13 tokens; expected one. It is not InternVL3's")
    (folder / "tokenizer.json").rename(folder / "vocab.json")
    assert_not_read(directory, "no tokenizer.json; expected that of InternVL3. Copy it from OpenGVLab/InternVL3-1B-hf")


def test_weights_of_another_training(directory: Path) -> None:
    path = directory / own.FILES["quantiles"]
    torch.save({"model": {}}, path)
    assert_not_read(directory, "no entry 'module' of weights; expected what Evo-1's training saved", names=path)
    path.unlink()
    assert_not_read(directory, "mp_rank_00_model_states.pt: no such file")


REFUSED: Refusals = {
    "config.json": [
        ({"per_action_dim": 7}, "per_action_dim is 7; expected 24, as many as the server of its authors has"),
        ({"state_dim": 8}, "state_dim is 8; expected 24"),
        ({"return_cls_only": True}, "return_cls_only is True; expected false"),
        ({"vision_masked": True}, "vision_masked is True; expected false"),
        ({"action_horizon": 8}, "action_horizon is 8; expected null, or 5, the horizon"),
        ({"normalization_type": "none"}, "normalization_type is 'none'; expected bounds or bounds_q99 or normal"),
        ({"image_size": {"image_1": [8, 8]}}, r"image_size is .*; expected \[height, width\], or one for each of"),
        ({"vlm_name": "OpenGVLab/other"}, "'OpenGVLab/other' is not on this machine"),
        ({"action_head": "diffusion"}, "action_head is 'diffusion'; expected flowmatching"),
        ({"num_categories": 2}, "do not fit the configuration: missing action_head.mlp_head.fc1.weight"),
    ],
    f"../{own.LANGUAGE['quantiles']}/config.json": [
        ({"select_layer": -2}, "select_layer is -2; expected -1"),
        ({"ps_version": "v1"}, "ps_version is 'v1'; expected v2"),
        ({"force_image_size": 224}, "force_image_size is 224; expected 448"),
    ],
    f"../{own.LANGUAGE['quantiles']}/config.json/vision_config": [
        ({"qk_normalization": True}, "qk_normalization is True; expected false")
    ],
    f"norm_stats.json/{own.ARM}/{own.DATASET}/action": [
        ({"q01": [0.0]}, "action.q01 and q99 have 1 and 4 numbers; expected as many"),
        ({"q01": [0, 1, 2, "x"]}, "q01 is .*; expected finite numbers"),
        ({"q01": [0.0] * 25, "q99": [1.0] * 25}, "max_action_dim is 24; expected at least the 25 numbers"),
    ],
    f"norm_stats.json/{own.ARM}/{own.DATASET}": [({"action": 0}, "action is 0; expected settings by name")],
}


@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_not_rebuilt_is_named(directory: Path, place: str, changes: dict[str, Any], message: str) -> None:
    assert_refused(directory, place, changes, message)
