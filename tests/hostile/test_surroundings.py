"""Some of what ``surroundings.py`` tries: each is a process, so that the suite has no time for all of them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.hostile.surroundings import COMMANDS, SETTINGS, judged, prepare, run


@pytest.fixture(scope="module")
def top(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("surroundings")
    prepare(folder, None)
    return folder


TRIED = {
    "output in ASCII": ("inspect", 0),
    "COLUMNS=1": ("inspect", 0),
    "all three closed": ("inspect -o", 0),
    "standard error full": ("inspect -o plan.png", 2),
    "in a folder that is gone": ("inspect a zip", 2),
    "in a folder whose name is no text": ("inspect", 0),
    "files of 8 KiB": ("inspect -o plan.png", 2),
}


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="devices and shells of Linux")
@pytest.mark.parametrize("surrounding", TRIED)
def test_a_command_ends_as_it_should(surrounding: str, top: Path) -> None:
    command, status = TRIED[surrounding]
    assert surrounding in SETTINGS
    assert run(top, surrounding, COMMANDS[command]) == (status, "")


@pytest.mark.parametrize(
    ("status", "told", "wrong"),
    [
        (1, "", "status 1"),
        (-11, "", "status -11"),
        (0, "Exception ignored in: <stdout>", "Exception ignored"),
        (2, "Traceback (most recent call last):", "Traceback"),
        (2, "error: a\nb\nc\nd\n", "no message of three lines"),
    ],
)
def test_a_bad_end_is_found(status: int, told: str, wrong: str, tmp_path: Path) -> None:
    assert judged(status, told, tmp_path).startswith(wrong)


def test_what_is_left_behind_is_found(tmp_path: Path) -> None:
    assert judged(0, "", tmp_path) == ""
    (tmp_path / f".page.html.{os.getpid():08x}.partial").touch()
    assert judged(0, "", tmp_path).startswith("left behind")


@pytest.mark.parametrize("room", [60_000_000, 110_000_000])
def test_without_memory_to_be_loaded_the_program_says_so(room: int) -> None:
    """Python's own errors come out of an import then, of several kinds. Between these OpenBLAS ends the process."""
    code = f"import resource, sys; resource.setrlimit(resource.RLIMIT_AS, ({room}, {room}));"
    code += "from ttscompile.__main__ import main; sys.argv = ['ttscompile', 'inspect', 'nothing']; main()"
    one = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # each takes memory of its own
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, env=one)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.splitlines()[-1].startswith("ttscompile cannot be loaded: ")
    assert "Traceback" not in result.stderr
