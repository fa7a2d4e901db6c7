"""How commands end: with which status, what they say, and what is left of what could not be written."""

import builtins
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ttscompile.__main__ import main as start
from ttscompile.cli import main
from ttscompile.cli.ending import Status
from ttscompile.errors import CalibrationFailedError, TtscompileError

COMMAND = [sys.executable, *(["-P"] if sys.version_info >= (3, 11) else []), "-m", "ttscompile"]


def test_a_warning_is_one_line_and_shows_no_python(tmp_path: Path, toy_compiled: Path) -> None:
    np.savez(tmp_path / "calls.npz", obs=np.zeros((4, 2), np.float32), episode_ends=[2, 3])
    command = [*COMMAND, "inspect", str(toy_compiled), "-t", "calls.npz", "-o", "map.png"]
    told = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stderr
    assert "warning: calls.npz: 1 rows after the last end of an episode are not used.\n" in told
    assert "UserWarning" not in told and ".py" not in told


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], None]:
    """Lets ``inspect`` end with an error."""

    def fails(error: BaseException) -> None:
        def load(*_: object) -> None:
            raise error

        # The package's attribute of this name is the command, not the module.
        monkeypatch.setattr(sys.modules["ttscompile.cli.inspect"], "load_artifact", load)

    return fails


@pytest.mark.parametrize(
    ("error", "status", "told"),
    [
        (TtscompileError("it is so"), 2, "error: it is so\n"),
        (CalibrationFailedError("not kept"), 1, "failed: not kept\n"),
        (MemoryError("of 3 EiB"), 2, "error: there is too little memory: of 3 EiB.\n"),
        (BrokenPipeError(32, "Broken pipe"), 141, ""),
        (ModuleNotFoundError("No module named 'x'", name="x"), 2, "error: a package cannot be imported: No module"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_what_was_foreseen(
    error: BaseException, status: int, told: str, failing: Callable[[BaseException], None]
) -> None:
    failing(error)
    result = CliRunner().invoke(main, ["inspect", "out"])
    assert (result.exit_code, result.stdout) == (status, "")
    assert result.stderr == told or (told and result.stderr.startswith(told.rstrip("\n")))


@pytest.mark.parametrize(
    "error", [ZeroDivisionError("a bug\nin two lines"), EOFError(), ImportError(name="ttscompile.x")]
)
def test_a_defect_is_no_failed_check(error: Exception, failing: Callable[[BaseException], None]) -> None:
    """What was run, what happened and where, and how to see the traceback."""
    failing(error)
    result = CliRunner().invoke(main, ["inspect", "an artifact", "--json"])
    assert (result.exit_code, result.stdout) == (Status.DEFECT, "")
    first, second = result.stderr.splitlines()
    assert first.startswith("defect: ") and "inspect 'an artifact' --json: " + type(error).__name__ in first
    assert "inspect.py:" in first
    assert "This is a defect of ttscompile" in second and second.endswith("--traceback inspect 'an artifact' --json")
    shown = CliRunner().invoke(main, ["--traceback", "inspect", "an artifact"])
    assert shown.exit_code == Status.DEFECT
    assert shown.stderr.startswith("Traceback (most recent call last)")
    assert shown.stderr.splitlines()[-1].endswith("report it with the traceback above.")


def test_an_interruption_of_the_imports_is_one_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(name: str, *more: object) -> object:
        if name == "ttscompile.cli":
            raise KeyboardInterrupt
        return imported(name, *more)  # type: ignore[arg-type]

    imported = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", interrupted)
    with pytest.raises(SystemExit, match="130"):
        start()


@pytest.mark.parametrize("before", [[], ["--traceback"]])
def test_what_can_go_on_says_so(before: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["ttscompile.cli.calibrate"], "manifest_of", interrupted)
    result = CliRunner().invoke(main, [*before, "calibrate", "out", "--trajectories", "a.npz"])
    told = "interrupted; the same command with --resume goes on\n"
    assert (result.exit_code, result.stderr) == (Status.INTERRUPTED, told)


def test_a_signal_in_a_library_in_c_is_no_defect(failing: Callable[[BaseException], None]) -> None:
    """Where Python finds an error that C has not handed on, as of Ray, it makes another one of it."""
    error = SystemError("<built-in method __new__> returned a result with an exception set")
    error.__cause__ = KeyboardInterrupt()
    failing(error)
    assert CliRunner().invoke(main, ["inspect", "an artifact"]).stderr == "interrupted\n"
    error.__cause__ = None
    failing(error)
    assert CliRunner().invoke(main, ["inspect", "an artifact"]).exit_code == Status.DEFECT


def test_an_artifact_that_is_called_like_a_command(failing: Callable[[BaseException], None]) -> None:
    failing(KeyboardInterrupt())
    assert CliRunner().invoke(main, ["inspect", "calibrate"]).stderr == "interrupted\n"


def test_a_signal_while_a_library_is_loaded_is_no_broken_package(failing: Callable[[BaseException], None]) -> None:
    """On a slow processor onnxruntime takes seconds, and pybind11 tells of any error in it as of an import's."""
    error = ImportError("initialization failed")
    error.__cause__ = KeyboardInterrupt()
    failing(error)
    result = CliRunner().invoke(main, ["inspect", "an artifact"])
    assert (result.exit_code, result.stderr) == (Status.INTERRUPTED, "interrupted\n")
    error.__cause__ = OSError("libpng.so: no such file")
    failing(error)
    assert CliRunner().invoke(main, ["inspect", "an artifact"]).exit_code == Status.REFUSED


def test_every_status_is_documented() -> None:
    told = " ".join(CliRunner().invoke(main, ["--help"]).stdout.split())
    page = (Path(__file__).parents[2] / "docs" / "reference" / "commands.md").read_text()
    for status in Status:
        assert f" {status.value} " in told
        assert f"| {status.value} |" in page


def run(*words: object, **settings: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *map(str, words)], text=True, stderr=subprocess.PIPE, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--help"], ["inspect", "A"], ["inspect", "A", "--json"], ["doctor", "--json"]])
def test_nobody_reads_the_results(words: list[str], toy_compiled: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        result = run(*[toy_compiled if word == "A" else word for word in words], stdout=writer)
    finally:
        os.close(writer)
    assert (result.returncode, result.stderr) == (Status.UNREAD, "")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize("words", [["--version"], ["inspect", "A"]])
def test_there_is_no_space_for_the_results(words: list[str], toy_compiled: Path) -> None:
    with Path("/dev/full").open("w") as full:
        result = run(*[toy_compiled if word == "A" else word for word in words], stdout=full)
    assert result.returncode == Status.REFUSED
    assert result.stderr.startswith("error: [Errno 28] No space left on device. Make space where the results go")
    assert result.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.compiles
def test_files_do_not_take_the_place_of_closed_streams(toy_compiled: Path, tmp_path: Path) -> None:
    """A library that prints would print into them."""
    code = "import os, sys; os.closerange(0, 3); os.execv(sys.argv[1], sys.argv[1:])"
    page = tmp_path / "page.html"
    words = [sys.executable, "-c", code, *COMMAND, "inspect", toy_compiled, "-o", page]
    assert subprocess.run(list(map(str, words))).returncode == 0
    assert page.read_text().startswith("<!doctype html>")
    inside = "import os; from ttscompile.cli import main; main.main(['--version'], standalone_mode=False); "
    inside += "open('opened', 'w').write(str(os.open('opened', os.O_RDONLY)))"
    assert subprocess.run([sys.executable, "-c", code, sys.executable, "-c", inside], cwd=tmp_path).returncode == 0
    assert int((tmp_path / "opened").read_text()) > 2


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_server_with_its_statistics(sent: int, toy_compiled: Path) -> None:
    words = [*COMMAND, "serve", str(toy_compiled), "--control-hz", "1", "--port", "0", "--margin-ticks", "0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        assert "url" in json.loads(server.stdout.readline())
        server.send_signal(sent)
        printed, told = server.communicate(timeout=30)
    assert (server.returncode, told) == (0, "")
    assert "statistics" in json.loads(printed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent", "status", "told"), [(signal.SIGINT, 130, "interrupted\n"), (signal.SIGTERM, 143, "ended by SIGTERM\n")]
)
def test_a_signal_ends_a_command_and_leaves_nothing(
    sent: int, status: int, told: str, toy_compiled: Path, tmp_path: Path
) -> None:
    """Of a zipped artifact there is a folder in the temporary one as long as the command runs."""
    archive = shutil.make_archive(str(tmp_path / "zipped"), "zip", toy_compiled)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    words = [*COMMAND, "bench", archive, "--calls", "10000", "--threads", "1,2,3,4"]
    settings = {"env": {**os.environ, "TMPDIR": str(temporary)}, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(words, text=True, **settings) as bench:  # type: ignore[call-overload]
        end = time.monotonic() + 60
        # Not any entry: tempfile tries the folder with a file of its own while Python still imports.
        while not any(temporary.glob("ttscompile-*")) and time.monotonic() < end:
            time.sleep(0.02)
        time.sleep(0.1)  # all calls take about ten seconds, so that a busy machine may wake this late
        bench.send_signal(sent)
        printed, said = bench.communicate(timeout=30)
    assert (bench.returncode, printed) == (status, ""), said
    assert said.endswith(told) and "Traceback" not in said
    assert list(temporary.iterdir()) == []
