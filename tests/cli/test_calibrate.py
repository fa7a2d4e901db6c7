"""How ``calibrate`` reads its command line: ``--trajectories`` takes several files."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.commands import refused, run
from ttscompile.calibration.proposers import PROPOSERS
from ttscompile.errors import CalibrationError, CalibrationFailedError

COMMAND = ("calibrate", "out", "--trajectories", "a.npz")


@pytest.fixture(autouse=True)
def there(toy_compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the command lines name exists."""
    (tmp_path / "out").symlink_to(toy_compiled)
    for name in ("a.npz", "b.npz"):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What ``ttscompile.calibrate`` was called with; the call itself ends in an error."""
    calls: list[Any] = []

    def calibrate(*args: Any, **kwargs: Any) -> None:
        calls.append((args, kwargs))
        raise CalibrationError("stopped here")

    monkeypatch.setattr("ttscompile.calibrate", calibrate, raising=False)
    return calls


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["out", "--trajectories", "a.npz", "b.npz", "--max-minutes", "3"],
        ["--max-minutes", "3", "out", "--trajectories", "a.npz", "b.npz"],
        ["--trajectories", "a.npz", "--trajectories", "b.npz", "--max-minutes", "3", "out"],
    ],
)
def test_every_file_up_to_the_next_option_is_taken(arguments: list[str], asked: list[Any]) -> None:
    assert refused("calibrate", *arguments) == "error: stopped here"
    ((args, kwargs),) = asked
    assert args == (Path("out"),)
    assert kwargs == {
        "trajectories": [Path("a.npz"), Path("b.npz")],
        "observation": {},
        "learn": ("schedule",),
        "target_sparsity": None,
        "target_flops": None,
        "seed": 0,
        "resume": False,
        "latency_ms": None,
        "max_action_error": None,
        "max_distance": None,
        "threads": 1,
        "max_minutes": 3.0,
        "device": None,
        "ray": None,
    }


def test_a_plan_that_is_not_what_was_asked_for_is_a_failed_check(monkeypatch: pytest.MonkeyPatch) -> None:
    def calibrate(*args: Any, **kwargs: Any) -> None:
        raise CalibrationFailedError("no better than the uniform schedule")

    monkeypatch.setattr("ttscompile.calibrate", calibrate, raising=False)
    result = run(*COMMAND)
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr == "failed: no better than the uniform schedule\n"


@pytest.mark.parametrize("doubtful", [False, True])
def test_a_plan_that_is_far_off_is_written_and_a_failed_check(monkeypatch: pytest.MonkeyPatch, doubtful: bool) -> None:
    monkeypatch.setattr("ttscompile.calibrate", lambda *_, **__: SimpleNamespace(doubtful=doubtful), raising=False)
    result = run(*COMMAND)
    assert result.exit_code == doubtful
    assert "All about it: ttscompile inspect out\nidentity " in result.stdout
    assert len(result.stdout.splitlines()) < 15, "the verdict, and not all that inspect shows"


def test_every_proposer_can_be_asked_for_and_the_help_has_its_name(asked: list[Any]) -> None:
    told = " ".join(run("calibrate", "--help").stdout.replace("-\n", "-").split())
    for row in PROPOSERS:
        run(*COMMAND, "--learn", row.name)
        assert asked[-1][1]["learn"] == (row.name,)
        assert row.name in told.replace("- ", "-")
    assert "schedule: which steps are computed, with corrections and jumps; loops: which loop" in told
    assert "'magic' is not one of schedule, tts-paper, interval" in refused(*COMMAND, "--learn", "magic")
    assert len(asked) == len(PROPOSERS)


def test_two_that_make_the_schedule_are_refused() -> None:
    told = "learn: expected one that makes the first plan; found 'schedule' and 'bac'. Take one of them."
    assert refused(*COMMAND, "--learn", "bac,schedule") == f"error: {told}"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--target-sparsity", "0"], "target_sparsity 0 asks for the dense policy"),
        (["--target-sparsity", "1"], "expected a number above 0 and below 1; found 1.0"),
        (["--latency-ms", "20", "--target-sparsity", "0.9"], "found target_sparsity and latency_ms. They exclude"),
        (["--max-action-error", "nan"], "nan is not in the range 0<x<="),
    ],
)
def test_a_budget_that_cannot_be_is_an_error(options: list[str], message: str) -> None:
    assert message in refused(*COMMAND, *options)


def test_budgets_reach_the_library(asked: list[Any]) -> None:
    run(*COMMAND, "b.npz", "--latency-ms", 20, "--threads", 2)
    ((_, kwargs),) = asked
    assert (kwargs["target_sparsity"], kwargs["latency_ms"], kwargs["threads"]) == (None, 20.0, 2)
    assert len(kwargs["trajectories"]) == 2
