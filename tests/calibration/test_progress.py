"""What is told of the course of the work, where nobody watches a bar."""

from io import StringIO

import pytest
from rich.console import Console

from ttscompile.calibration import progress
from ttscompile.calibration.progress import Bar


def test_a_log_has_a_line_for_each_part_and_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    with Bar(shown=True) as bar:
        for done in range(3):
            bar.tell("dense calls", done, 2)
        bar.warn("few")
        bar.stage("search", 5)
        bar.best("2 of 16 steps")
    told = "dense calls: 2 to do\nwarning: few\nsearch: 5 to do\nbest so far: 2 of 16 steps\n"
    assert capsys.readouterr().err == told


def test_nothing_is_told_where_nothing_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with Bar(shown=False) as bar:
        bar.tell("dense calls", 0, 2)
        bar.warn("few")
        bar.best("2 of 16 steps")
    assert capsys.readouterr().err == ""


def test_a_bar_goes_on_showing_the_best_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = StringIO()
    monkeypatch.setattr(progress, "Console", lambda stderr: Console(file=shown, force_terminal=True, width=200))
    with Bar(shown=True) as bar:
        bar.best("2 of 16 steps")
        bar.stage("search", 5)
        bar.update(1, "some", 60.0)
    last = next(line for line in reversed(shown.getvalue().splitlines()) if "search" in line)
    assert "best so far: 2 of 16 steps" in last and "at most 1.0 min left" in last
