"""What the cache of the hub's library holds may be damaged: the library looks at names alone."""

from pathlib import Path

import pytest
from click.testing import CliRunner

import ttscompile
from ttscompile.cli import main
from ttscompile.errors import ArtifactError

from .served import Hub


def test_a_damaged_file_of_the_cache_is_downloaded_again(hub: Hub, toy_files: dict[str, bytes]) -> None:
    """The library takes a file that has the right name for the right one."""
    hub.commit("org/name", toy_files)
    first = ttscompile.load("hf://org/name", seed=0)
    (cached,) = {path.resolve() for path in first_files("weights.safetensors")}
    content = cached.read_bytes()
    cached.chmod(0o644)
    cached.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    before = len(hub.asked)
    assert ttscompile.load("hf://org/name", seed=0).info.identity == first.info.identity
    assert any("resolve" in each and "weights" in each for each in hub.asked[before:])
    (cached,) = {path.resolve() for path in first_files("weights.safetensors")}
    assert cached.read_bytes() == content


def test_an_artifact_that_is_wrong_there_is_refused_after_one_more_try(hub: Hub, toy_files: dict[str, bytes]) -> None:
    content = toy_files["weights.safetensors"]
    hub.commit("org/name", {**toy_files, "weights.safetensors": content[:-1] + bytes([content[-1] ^ 1])})
    with pytest.raises(ArtifactError, match=r"weights\.safetensors: expected sha256"):
        ttscompile.load("hf://org/name")
    assert sum(each.startswith("GET") and "resolve" in each and "weights" in each for each in hub.asked) <= 3


def first_files(name: str) -> list[Path]:
    from huggingface_hub import constants

    return list(Path(constants.HF_HUB_CACHE).glob(f"*/snapshots/*/{name}"))


def test_commands_that_read_no_repository_say_so() -> None:
    result = CliRunner().invoke(main, ["inspect", "hf://org/name"])
    assert result.exit_code == 2
    assert "hf://org/name is on the hub, and this takes what is on this machine" in " ".join(result.stderr.split())
