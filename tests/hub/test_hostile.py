"""A hub that is itself hostile: what it says is no path on this machine."""

from pathlib import Path

import pytest

from ttscompile.errors import HubError
from ttscompile.hub import fetch_artifact, fetch_checkpoint

from .served import Hub


@pytest.mark.parametrize("commit", ["../../../../outside", "/tmp/outside", "x" * 40, "A" * 40, "", "0" * 39])
@pytest.mark.parametrize("fetch", [fetch_artifact, fetch_checkpoint])
def test_a_commit_that_is_none_names_no_folder(
    commit: str, fetch: object, hub: Hub, toy_files: dict[str, bytes], tmp_path: Path
) -> None:
    hub.commits["org/name"] = [(commit, dict(toy_files))]
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(HubError, match="hf://org/name: expected a commit of 40 digits from the hub; found"):
        fetch("hf://org/name")  # type: ignore[operator]
    assert sorted(tmp_path.rglob("*")) == before
    assert not hub.downloaded()
