"""What is told of the course of the work, where nobody watches a bar."""

import pytest

from ttscompile.calibration.progress import Bar


def test_a_log_has_a_line_for_each_part_and_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    with Bar(shown=True) as bar:
        for done in range(3):
            bar.tell("dense calls", done, 2)
        bar.warn("few")
        bar.stage("search", 5)
    assert capsys.readouterr().err == "dense calls: 2 to do\nwarning: few\nsearch: 5 to do\n"


def test_nothing_is_told_where_nothing_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with Bar(shown=False) as bar:
        bar.tell("dense calls", 0, 2)
        bar.warn("few")
    assert capsys.readouterr().err == ""
