"""SIGKILL at every operation on files of what is written: the old, the new, never a half. ``kill.py`` has the long run.

All of it runs in one process of its own, which forks: pytest's has threads.
"""

import errno
import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.artifact.folders import contents
from ttscompile.artifact import files
from ttscompile.artifact.files import exchange, new_folder, recover, replace_folder

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_killed_at_every_operation() -> None:
    command = [sys.executable, "-m", "tests.hostile.kill_toys"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    found = {line["scenario"]: line for line in map(json.loads, result.stdout.splitlines())}
    assert list(found) == ["write fresh", "write again", "update", "save state"]
    assert [line["failures"] for line in found.values()] == [[]] * 4
    assert [line["kills"] > 5 for line in found.values()] == [True, True, True, False]


@pytest.mark.slow
def test_builds_that_are_killed_twenty_times_and_resumed_end_with_the_same_bytes() -> None:
    command = [sys.executable, "-m", "tests.hostile.kill_builds", "--kills", "20"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stdout + result.stderr
    found = json.loads(result.stdout)
    assert found["failures"] == [] and sum(found["killed"].values()) == 20
    assert all(found["killed"].get(phase) for phase in found["moments"]), "a phase in which nothing was killed"


def folder(path: Path, text: str) -> Path:
    path.mkdir()
    (path / "file").write_text(text)
    return path


def test_two_folders_change_places(tmp_path: Path) -> None:
    one, other = folder(tmp_path / "one", "1"), folder(tmp_path / "other", "2")
    assert exchange(one, other)
    assert (contents(one), contents(other)) == ({"file": b"2"}, {"file": b"1"})
    assert not exchange(one, tmp_path / "none")


@pytest.mark.parametrize("crash", [False, True])
def test_where_the_file_system_cannot_exchange(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, crash: bool) -> None:
    target, partial = folder(tmp_path / "compiled", "old"), folder(tmp_path / ".compiled.00000000.partial", "new")
    monkeypatch.setattr(files, "exchange", lambda one, other: False)
    if crash:
        target.rename(tmp_path / ".compiled.replaced")  # and no more: what a kill between the two renames leaves
        recover(target)
        assert contents(target) == {"file": b"old"}
    else:
        replace_folder(partial, target)
        assert contents(target) == {"file": b"new"}
        assert [path.name for path in tmp_path.iterdir()] == ["compiled"]


def test_a_rename_that_fails_puts_the_old_one_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target, partial = folder(tmp_path / "compiled", "old"), folder(tmp_path / ".compiled.00000000.partial", "new")
    original = Path.replace

    def replace(self: Path, other: Path) -> Path:
        if self == partial:
            raise OSError(errno.EIO, "no")
        return original(self, other)

    monkeypatch.setattr(files, "exchange", lambda one, other: False)
    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(OSError, match="no"):
        replace_folder(partial, target)
    assert contents(target) == {"file": b"old"}


@pytest.mark.parametrize("letter", ["l", "\N{EURO SIGN}"])  # of one byte and of three
def test_names_as_long_as_names_may_be(letter: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is unfinished, or was replaced, has a longer one, which has to fit and to be its own."""
    long = letter * (255 // len(letter.encode()))
    for name in (long, long[:-1]):
        files.replace_file(tmp_path / f"{name}", b"content")
        (tmp_path / name).unlink()
    target, other = folder(tmp_path / long, "old"), folder(tmp_path / long[:-1], "other")
    abandoned = folder(files.beside(target), "x")
    monkeypatch.setattr(files, "exchange", lambda one, other: False)
    with new_folder(other) as partial:
        assert abandoned.exists(), "it is another one's"
    with new_folder(target) as partial:
        assert not abandoned.exists()
        (partial / "file").write_text("new")
        replace_folder(partial, target)
    assert (contents(target), contents(other)) == ({"file": b"new"}, {"file": b"other"})
    assert sorted(tmp_path.iterdir()) == sorted([target, other])


def test_abandoned_folders_go_and_those_of_the_living_stay(tmp_path: Path) -> None:
    target = tmp_path / "compiled"
    abandoned, stranger = folder(tmp_path / ".compiled.0123abcd.partial", "x"), folder(tmp_path / ".other.partial", "x")
    with new_folder(target) as first:
        assert not abandoned.exists()
        assert stranger.exists()
        with new_folder(target) as second:
            assert first.exists()
            assert first.parent.samefile(second.parent)
        assert not second.exists()
    assert not first.exists()
