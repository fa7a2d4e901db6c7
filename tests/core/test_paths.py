"""Paths that lead to something that may be read for ever: each is refused unread, by whatever takes a path."""

import os
import shutil
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import ttscompile
from tests.commands import run
from tests.once import Once
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile.artifact.files import replace_file
from ttscompile.artifact.load import load_artifact
from ttscompile.core.paths import require_free_or_path, require_path
from ttscompile.errors import ArtifactError, CalibrationError, CheckpointError, TrajectoryError, TtscompileError
from ttscompile.trajectories import load_trajectories


@pytest.fixture(autouse=True)
def soon() -> Iterator[None]:
    """What reads a pipe waits for ever: not here."""

    def late(*_: object) -> None:
        raise AssertionError("it was read")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(params=["pipe", "socket", "/dev/null", "/dev/zero"])
def endless(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return make(request.param, tmp_path / "endless")


def make(kind: str, path: Path) -> Path:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with inside(path.parent), socket.socket(socket.AF_UNIX) as bound:  # their names are short
            bound.bind(path.name)
    else:
        path.symlink_to(kind)
    return path


@contextmanager
def inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


@pytest.fixture(scope="module")
def artifact(once: Once) -> Path:
    return once.folder("toy", lambda directory: written_artifact(toy_program(), directory))


FOUND = r"endless: expected a file or a directory; found a (pipe|socket|device)\. Give "


def test_functions_that_take_a_path(endless: Path, artifact: Path, tmp_path: Path) -> None:
    specs = load_artifact(artifact).manifest.spec.observations
    with pytest.raises(ArtifactError, match=FOUND):
        ttscompile.load(endless)
    with pytest.raises(ArtifactError, match=FOUND):
        ttscompile.verify(endless)
    with pytest.raises(CheckpointError, match=FOUND):
        ttscompile.convert(endless, tmp_path / "compiled")
    with pytest.raises(ArtifactError, match=FOUND):
        ttscompile.convert(artifact, endless)
    with pytest.raises(ArtifactError, match=FOUND):
        ttscompile.calibrate(endless, [tmp_path / "none.npz"])
    with pytest.raises(TrajectoryError, match=FOUND):
        load_trajectories([endless], specs, 1)


@pytest.mark.parametrize(
    "command",
    [
        ["inspect", "PATH"],
        ["verify", "PATH"],
        ["verify", "ARTIFACT", "--trajectories", "PATH"],
        ["bench", "PATH"],
        ["serve", "PATH", "--control-hz", "10"],
        ["calibrate", "PATH", "--trajectories", "PATH"],
        ["calibrate", "ARTIFACT", "--trajectories", "PATH"],
        ["bench", "ARTIFACT", "-t", "PATH"],
        ["bench", "ARTIFACT", "--with", "PATH"],
        ["convert", "PATH", "-o", "OUTPUT"],
        ["convert", "ARTIFACT", "-o", "PATH"],
        ["inspect", "PATH", "-o", "OUTPUT.html"],
        ["inspect", "ARTIFACT", "-o", "OUTPUT.html", "--trajectories", "PATH"],
    ],
)
def test_commands_that_take_a_path(artifact: Path, tmp_path: Path, command: list[str]) -> None:
    for kind in ("pipe", "/dev/zero"):
        names = {"PATH": make(kind, tmp_path / "endless"), "ARTIFACT": artifact, "OUTPUT": tmp_path / "out"}
        result = run(*(str(names.get(word, word)).replace("OUTPUT", str(tmp_path / "out")) for word in command))
        names["PATH"].unlink()
        assert result.exit_code == 2, result.output
        assert "endless: expected a file or a directory; found a " in result.stderr
        assert result.stderr.count("\n") <= 3


@pytest.mark.parametrize("name", ["manifest.json", "weights.safetensors", "stem.onnx", "program.json"])
def test_inside_an_artifact(artifact: Path, tmp_path: Path, name: str) -> None:
    path = shutil.copytree(artifact, tmp_path / "artifact") / name
    path.unlink()
    make("pipe", path)
    with pytest.raises(ArtifactError, match=rf"{name}: cannot be read: expected a file; found something else"):
        ttscompile.load(path.parent)


def test_a_state_to_resume_from(tmp_path: Path) -> None:
    from ttscompile.calibration.state import FILE, StateFile

    make("pipe", tmp_path / FILE)
    with pytest.raises(CalibrationError, match="expected a file; found something else"):
        StateFile(tmp_path, {}).load()


def test_a_file_never_takes_the_place_of_a_device(endless: Path) -> None:
    """``--single-file /dev/null`` would replace it, for everybody on the machine."""
    before = endless.stat()
    with pytest.raises(OSError, match="something else than a file is there"):
        replace_file(endless, b"content")
    assert os.path.samestat(endless.stat(), before)
    assert [path.name for path in endless.parent.iterdir()] == [endless.name]


@pytest.mark.parametrize(
    ("name", "message"), [("n" * 256, "File name too long"), ("none\0", "null"), ("none", "does not exist")]
)
def test_names_that_cannot_be(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(ArtifactError, match=message) as caught:
        ttscompile.load(tmp_path / name)
    assert len(str(caught.value)) < 500


def test_a_link_to_nothing_is_called_so_and_a_free_name_is_free(tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to("nowhere")
    with pytest.raises(TtscompileError, match=r"link: does not exist \(it is a link to nothing\)\. Give another\."):
        require_path(link, TtscompileError, "Give another.")
    require_free_or_path(tmp_path / "free", TtscompileError, "Give another.")
    require_path(tmp_path, TtscompileError, "Give another.")
