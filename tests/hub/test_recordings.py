"""LeRobot data sets from a hub: their first episodes, and those that a policy was trained on."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from tests.trajectories.data_sets import ENDS, as_lerobot, as_lerobot_with_videos
from ttscompile import builder
from ttscompile.cli import main
from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import CalibrationError, CheckpointError, HubError, TrajectoryError
from ttscompile.frontends import recordings_of
from ttscompile.trajectories import episodes, load_trajectories

from .served import Hub

pytestmark = pytest.mark.filterwarnings("ignore:.*episodes are read:UserWarning")

SPECS = {"top": ObservationSpec((2, 3, 16, 32)), "state": ObservationSpec((2, 5))}
NAME = "hf://datasets/org/data"


def commit(hub: Hub, root: Path, version: int = 3) -> None:
    """Of version 2 each episode has a table of its own; of version 3 the second is in another file than the first."""
    files = {file.relative_to(root).as_posix(): file.read_bytes() for file in root.rglob("*") if file.is_file()}
    if version == 2:
        files = {name.replace("file-", "episode_000"): content for name, content in files.items()}
    hub.commit("datasets/org/data", {**files, "README.md": b"---\nlicense: mit\n---\n", "other.bin": b"0"})


@pytest.mark.parametrize("version", [2, 3])
def test_the_first_episodes_are_those_of_the_data_set(hub: Hub, tmp_path: Path, version: int) -> None:
    root = as_lerobot_with_videos(tmp_path, version)
    commit(hub, root, version)
    whole, found = load_trajectories([root], SPECS, 2), load_trajectories([NAME], SPECS, 2)
    assert len(found) == {2: 2, 3: 1}[version]
    for one, other in zip(whole, found, strict=False):
        assert all(np.array_equal(one.observations[key], other.observations[key]) for key in SPECS)
    assert {"other.bin", "data/chunk-000/file-001.parquet"}.isdisjoint(hub.downloaded())


def test_an_episode_without_its_video_ends_what_is_read(hub: Hub, tmp_path: Path) -> None:
    root = as_lerobot_with_videos(tmp_path, 2)
    (root / "videos/chunk-000/top/episode_000001.mp4").unlink()
    commit(hub, root, 2)
    (found,) = load_trajectories([NAME], SPECS, 2)
    assert found.calls == -(-ENDS[0] // 2)


def test_no_more_are_read_than_asked_for(tmp_path: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    root = as_lerobot(tmp_path)
    commit(hub, root, 2)
    specs = {"state": ObservationSpec((2, 5))}
    assert len(load_trajectories([NAME], specs, 2)) == 2
    monkeypatch.setattr(episodes, "MOST_EPISODES", 1)
    assert len(load_trajectories([NAME], specs, 2)) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hf://org/data", "expected hf://datasets/ORGANISATION/NAME, and perhaps"),
        ("hf://datasets/org", "this is no name of a repository"),
        ("hf://datasets/org/none", "org/none"),
        ("hf://datasets/org/empty", "there is no meta/info.json in it; expected a LeRobot data set"),
    ],
)
def test_what_is_no_data_set_is_refused(hub: Hub, text: str, message: str) -> None:
    hub.commit("datasets/org/empty", {"README.md": b"x"})
    with pytest.raises(HubError, match=message):
        load_trajectories([text], SPECS, 2)


def trained(folder: Path, noted: object = None) -> Path:
    """What LeRobot's training saved, as far as it matters here."""
    folder.mkdir(exist_ok=True)
    (folder / "config.json").write_text(json.dumps({"type": "diffusion"}))
    if noted is not None:
        (folder / "train_config.json").write_text(json.dumps(noted))
    return folder


@pytest.mark.parametrize("noted", [None, {}, {"dataset": {"repo_id": 3}}, {"dataset": "org/data"}])
def test_a_checkpoint_that_names_no_data_set_wants_recordings(tmp_path: Path, noted: object) -> None:
    with pytest.raises(CheckpointError, match="does not say which data set it was trained on. Give recorded episodes"):
        recordings_of(trained(tmp_path, noted))


def data_set(folder: Path) -> Path:
    """As much of one as tells that it is there."""
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text("{}")
    return folder


@pytest.mark.parametrize("variable", ["HF_LEROBOT_HOME", "HF_HOME", "XDG_CACHE_HOME"])
def test_a_checkpoint_says_what_it_was_trained_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str
) -> None:
    """On the hub, unless it is on this machine: where LeRobot keeps its own, or where the training read it."""
    for each in ("HF_LEROBOT_HOME", "HF_HOME"):
        monkeypatch.delenv(each, raising=False)
    monkeypatch.setenv(variable, str(tmp_path))
    root = tmp_path / "mine"
    policy = trained(tmp_path / "policy", {"dataset": {"repo_id": "org/data", "root": str(root)}})
    assert recordings_of(policy) == NAME
    below = {"HF_LEROBOT_HOME": "", "HF_HOME": "lerobot", "XDG_CACHE_HOME": "huggingface/lerobot"}[variable]
    own = data_set(tmp_path / below / "org/data")
    assert recordings_of(policy) == str(own)
    assert recordings_of(trained(policy, {"dataset": {"repo_id": "org/data", "root": None}})) == str(own)
    assert recordings_of(trained(policy, {"dataset": {"repo_id": "org/data", "root": str(data_set(root))}})) == str(
        root
    )


def test_a_name_leads_nowhere_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path / "home"))
    data_set(tmp_path / "other")
    for name in ("../other", str(tmp_path / "other")):
        assert recordings_of(trained(tmp_path, {"dataset": {"repo_id": name}})) == f"hf://datasets/{name}"


def test_build_says_from_what_it_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: Any, **__: Any) -> None:
        raise CalibrationError("as far as this.")

    monkeypatch.setattr(builder, "convert", stopped)
    policy = trained(tmp_path / "policy", {"dataset": {"repo_id": "org/data"}})
    result = CliRunner().invoke(main, ["build", str(policy), "-o", str(tmp_path / "compiled")])
    assert result.exit_code == 2
    told = " ".join(result.stderr.split())
    assert f"no episodes were given, so those of its training are read: {NAME}" in told


def test_how_many_are_read_is_told(hub: Hub, tmp_path: Path) -> None:
    commit(hub, as_lerobot(tmp_path), 2)
    with pytest.warns(UserWarning, match=f"{NAME}: its first 2 episodes are read"):
        load_trajectories([NAME], {"state": ObservationSpec((2, 5))}, 2)


def test_the_first_episode_needs_its_videos(hub: Hub, tmp_path: Path) -> None:
    root = as_lerobot_with_videos(tmp_path, 2)
    (root / "videos/chunk-000/top/episode_000000.mp4").unlink()
    commit(hub, root, 2)
    with pytest.raises(TrajectoryError, match="the first episode has no videos of top in the first files"):
        load_trajectories([NAME], SPECS, 2)
