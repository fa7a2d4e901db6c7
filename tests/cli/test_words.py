"""Every option of every command takes what it is for, and refuses the rest: one message, and status 2."""

import json
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner, Result

from tests.commands import done, refused
from ttscompile.cli import main
from ttscompile.cli.sections import Section
from ttscompile.serving import listener

NO_TEXT = os.fsdecode(b"\xff\xfe.html")
UNKIND = (
    "-1",
    "0",
    "1e-320",
    "1e300",
    "inf",
    "-inf",
    "nan",
    "",
    "9" * 300,
    "l" * 300,
    NO_TEXT,
    "\x1b[31m",
    "a\nb",
    "0x1",
)

NEEDED: dict[str, list[tuple[str, ...]]] = {
    "bench": [
        ("A", "--calls", "1"),
        ("A", "--calls", "1", "--control-hz", "1"),
        ("A", "--calls", "1", "--trajectories", "calls.npz"),
        ("A", "--calls", "1", "--checkpoint", "policy.ckpt"),
    ],
    "build": [
        ("policy.ckpt", "-t", "calls.npz", "-o", "out"),
        ("policy.ckpt", "-t", "calls.npz", "-o", "out", "--control-hz", "1"),
    ],
    "calibrate": [("A", "-t", "calls.npz", "--max-minutes", "0.001")],
    "convert": [("policy.ckpt", "-o", "out")],
    "doctor": [("A",)],
    "inspect": [("A",), ("A", "--output", "out.html"), ("A", "-o", "plan.png")],
    "predict": [("A", "--state", "0.5,-1")],
    "push": [("A", "org/name", "--dry-run")],
    "serve": [("A", "--control-hz", "1", "--port", "0", "--margin-ticks", "0"), ("A", "--copies", "1", "--port", "0")],
    "verify": [("A",)],
}
"""Command lines of each command that can be run, and end soon: one for each section of its options."""


def parameters() -> Iterator[tuple[str, click.Parameter]]:
    for name, command in main.commands.items():
        for parameter in command.params:
            if isinstance(parameter, click.Argument) or not (parameter.is_flag or parameter.is_eager):  # type: ignore[attr-defined]
                yield name, parameter


ALL = [pytest.param(name, one, id=f"{name} {one.opts[-1]}") for name, one in parameters()]


@pytest.fixture(autouse=True)
def there(toy_compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the command lines above name."""
    shutil.copytree(toy_compiled, tmp_path / "A")  # which is calibrated here
    (tmp_path / "policy.ckpt").touch()
    obs = np.random.default_rng(0).uniform(-0.1, 0.1, (8, 2)).astype(np.float32)  # what its normaliser knows
    np.savez(tmp_path / "calls.npz", obs=obs, episode_ends=[4, 8])
    monkeypatch.chdir(tmp_path)


def line_for(command: str, parameter: click.Parameter) -> tuple[str, ...]:
    """The first command line in which the parameter is of use."""
    sections: tuple[Section, ...] = getattr(main.commands[command], "sections", ())
    needs = next((section.needs for section in sections if parameter.name in section.options), ())
    wanted = {word for one in main.commands[command].params if one.name in needs for word in one.opts}
    return next(line for line in NEEDED[command] if not wanted or wanted & set(line))


def with_word(command: str, parameter: click.Parameter, word: str) -> list[str]:
    """The command line with this word for the parameter."""
    words = list(line_for(command, parameter))
    if isinstance(parameter, click.Argument):
        return [command, *words[1:], "--", word]
    name = max(parameter.opts, key=len)
    for given in parameter.opts:
        if given in words:
            del words[words.index(given) : words.index(given) + 2]
    return [command, *words, f"{name}={word}"]


@pytest.fixture(autouse=True)
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine a command warns before it refuses."""
    monkeypatch.setattr("os.getloadavg", lambda: (0.0, 0.0, 0.0))


def judged(result: Result, words: list[str]) -> None:
    told = f"{words}: {result.exit_code} {result.stderr!r:.2000} {result.exception!r}"
    assert result.exit_code in (0, 1, 2), told
    assert "Traceback" not in result.output and "defect" not in result.stderr, told
    if result.exit_code == 2:
        message = result.stderr.split("\n\n")[-1]
        assert message.startswith(("Error: ", "error: ")) and 0 < message.count("\n") <= 3, told
        assert len(message) < 1500, told


@pytest.fixture
def stops_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server ends as soon as it listens, and a fleet has no copies."""
    run = listener.Listener.run

    async def brief(self: Any, host: str, port: int, stop: Any, on_start: Any) -> None:
        stop.set()
        await run(self, host, port, stop, on_start)

    @contextmanager
    def nobody(*_: Any) -> Iterator[None]:
        yield

    monkeypatch.setattr(listener.Listener, "run", brief)
    monkeypatch.setattr(sys.modules["ttscompile.serving.command"], "ray_copies", nobody)


@pytest.mark.slow
@pytest.mark.usefixtures("stops_at_once")
@pytest.mark.parametrize(("command", "parameter"), ALL)
def test_unkind_words_are_refused_or_taken(command: str, parameter: click.Parameter) -> None:
    """What its type takes is a number, a name or a path; and with that the command itself ends as it should."""
    for word in UNKIND:
        words, taken = with_word(command, parameter, word), list[Any]()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(main.commands[command], "callback", lambda taken=taken, **given: taken.append(given))
            result = CliRunner().invoke(main, words)
        judged(result, words)
        assert (result.exit_code == 0) == bool(taken), words
        for given in taken:
            assert_of_use(given[parameter.name], words)
            judged(CliRunner().invoke(main, words), words)


def assert_of_use(value: object, words: list[str]) -> None:
    """A finite number of moderate size, or text; a path that can be looked up."""
    match value:
        case tuple() | dict():
            for one in value:
                assert_of_use(one, words)
        case float():
            assert np.isfinite(value) and abs(value) < 1e31, words
        case int():
            assert abs(value) < 2**63, words
        case str():
            value.encode()
        case Path():
            assert value.name and len(value.name) < 256, words
            str(value).encode()


@pytest.mark.parametrize(
    ("word", "url"),
    [("0.0.0.0", "ws://0.0.0.0:"), ("127.1.2.3", "ws://127.1.2.3:"), ("::1", "ws://[::1]:"), ("localhost", "ws://")],
)
@pytest.mark.usefixtures("stops_at_once")
def test_the_url_is_where_the_server_listens(word: str, url: str) -> None:
    words = ["serve", *NEEDED["serve"][0], "--host", word]
    if word == "0.0.0.0":
        assert "may be reached from other machines" in refused(*words)
        words.append("--insecure")
    result = done(*words)
    warned = "warning: there is no token and no certificate: whoever reaches 0.0.0.0 can drive" in result.stderr
    assert warned == (word == "0.0.0.0")
    assert json.loads(result.stdout.splitlines()[0])["url"].startswith(url)


@pytest.mark.parametrize("word", ["", "l" * 300, NO_TEXT, "example.org", "0", "nan"])
def test_a_host_that_is_no_address_is_refused(word: str) -> None:
    assert "expected an IP address of this machine" in refused("serve", *NEEDED["serve"][0], f"--host={word}")


def test_all_commands_together_have_at_most_a_hundred_options() -> None:
    """What only authors of a method need is in the Python interface."""
    options = [one for command in main.commands.values() for one in command.params if isinstance(one, click.Option)]
    assert len(options) <= 100
    assert len(main.commands) <= 10


def test_help_begins_with_what_an_option_does() -> None:
    begun = {
        (one.help or "").split()[0].rstrip(",")
        for command in main.commands.values()
        for one in command.params
        if isinstance(one, click.Option)
    }
    assert begun == {
        *("Answer", "Be", "Check", "Choose", "Compile", "Compute", "Count", "Draw", "Drive", "Execute", "Find", "Give"),
        *("Go", "Have", "Hold", "Keep", "Learn", "Leave", "Let", "Listen", "Look", "Make", "Merge", "Name", "Play"),
        *("Predict", "Print", "Put", "Read", "Replace", "Reuse", "Run", "Save", "Say", "See", "Show", "Take", "Time"),
        *("Work", "Write"),
    }
