"""Files by which LeRobot takes a compiled policy for one of its own. ``tests/plugins`` has LeRobot read them."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import ttscompile
from tests.plans import store_schedules
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import BESIDE
from ttscompile.core.lattice import dense_plan
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.policies.lerobot.files import files_beside

from . import lerobot_unets, pis
from .lerobot_tiny import DA, DS, SIDE, change_json, save_policy

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:normaliser of observation.state")]

STATE, TOP = "observation.state", "observation.images.top"


def read(folder: Path, name: str) -> Any:
    return json.loads((folder / name).read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy with a camera that the robot calls otherwise, and the compiled one."""
    folder = tmp_path_factory.mktemp("files")
    renamed = {"observation.images.front": TOP}
    tokenizer = {"max_length": 9, "padding": "longest", "tokenizer_name": "somebody/clip-small"}
    directory = save_policy(folder, ("top",), renamed=renamed)
    steps = read(directory, "policy_preprocessor.json")["steps"]
    change_json(
        directory / "policy_preprocessor.json",
        steps=[*steps[:2], {"registry_name": "tokenizer_processor", "config": tokenizer}, *steps[2:]],
    )
    ttscompile.convert(directory, folder / "compiled")
    return folder


def test_they_say_what_the_robot_gives_and_normalise_nothing(folder: Path) -> None:
    assert read(folder / "compiled", "config.json") == {
        "type": "ttscompile",
        "n_obs_steps": 2,
        "n_action_steps": 4,
        "input_features": {
            STATE: {"type": "STATE", "shape": [DS]},
            "observation.images.front": {"type": "VISUAL", "shape": [3, SIDE, SIDE]},
        },
        "output_features": {"action": {"type": "ACTION", "shape": [DA]}},
        "device": "cpu",
    }
    device = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
    tokenizer = {"max_length": 9, "padding": "max_length", "tokenizer_name": "somebody/clip-small"}
    assert read(folder / "compiled", "policy_preprocessor.json")["steps"] == [
        {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
        {"registry_name": "to_batch_processor", "config": {}},
        {"registry_name": "tokenizer_processor", "config": tokenizer},
        device,
    ]
    assert read(folder / "compiled", "policy_postprocessor.json") == {"name": "policy_postprocessor", "steps": [device]}


def test_the_artifact_is_the_same_without_them(folder: Path, tmp_path: Path) -> None:
    """They are no part of it: load, its identity and calibration leave them alone, and a zip may lack them."""
    whole, bare = shutil.copytree(folder / "compiled", tmp_path / "whole"), tmp_path / "bare"
    manifest = load_artifact(whole).manifest
    assert not set(BESIDE) & set(manifest.files) and set(BESIDE) <= {path.name for path in whole.iterdir()}
    shutil.copytree(whole, bare, ignore=shutil.ignore_patterns(*BESIDE))
    assert load_artifact(bare).manifest.identity == manifest.identity
    change_json(whole / "config.json", threads=2)
    zipped = load_artifact(Path(shutil.make_archive(str(tmp_path / "zipped"), "zip", whole)))
    assert zipped.manifest.identity == manifest.identity and not (zipped.path / "config.json").exists()
    plan = dense_plan(manifest.steps, len(manifest.blocks))
    store_schedules(whole, None, {"all": plan}, "all", {})
    assert read(whole, "config.json")["threads"] == 2


@pytest.mark.soak
def test_they_are_the_same_bytes_again_and_go_with_an_artifact_that_is_replaced(folder: Path, tmp_path: Path) -> None:
    spec, again = load_artifact(folder / "compiled").manifest.spec, tmp_path / "again"
    made = files_beside(folder / "policy", spec)
    assert {name: (folder / "compiled" / name).read_bytes() for name in BESIDE} == made
    shutil.copytree(folder / "compiled", again)
    ttscompile.convert(lerobot_unets.save("states", tmp_path / "states"), again)
    assert read(again, "config.json")["input_features"] == {
        STATE: {"type": "STATE", "shape": [lerobot_unets.STATE_DIM]},
        lerobot_unets.ENVIRONMENT: {"type": "ENV", "shape": [5]},
    }
    assert "tokenizer" not in (again / "policy_preprocessor.json").read_text()


@pytest.mark.parametrize("kind", pis.KINDS)
def test_there_are_none_where_the_instruction_holds_the_state(tmp_path: Path, kind: str) -> None:
    directory = pis.save(kind, tmp_path / "policy")
    _, spec = load_checkpoint_policy(directory)
    assert set(files_beside(directory, spec)) == (set(BESIDE) if kind == "pi0" else set())


def test_convert_says_that_there_are_none(tmp_path: Path) -> None:
    said: dict[str, tuple[str, ...]] = {}
    ttscompile.convert(pis.save("pi05", tmp_path / "policy"), tmp_path / "compiled", explain=said.__setitem__)
    assert said["files_beside"] == ("none: no step of its program makes the tokens that this policy reads",)
    assert not {path.name for path in (tmp_path / "compiled").iterdir()} & set(BESIDE)


@pytest.mark.parametrize("format", ["auto", "lerobot"])
def test_a_compiled_policy_is_not_taken_for_one_that_lerobot_trained(folder: Path, tmp_path: Path, format: str) -> None:
    with pytest.raises(CheckpointError, match="an artifact that is compiled already"):
        ttscompile.convert(folder / "compiled", tmp_path / "twice", format=format)
