"""How late a loop wakes, alone and beside a plan."""

from __future__ import annotations

import json
from pathlib import Path

from click.testing import CliRunner
from jitter import main

from tests.once import Once
from tests.runtimes.toys import toy_program, written_artifact


def test_the_loop_is_measured_alone_and_beside_the_plan(once: Once) -> None:
    compiled: Path = once.folder("toy", lambda directory: written_artifact(toy_program(), directory))
    words = [str(compiled), "--policy-hz", "10", "--seconds", "0.2"]
    told = json.loads(CliRunner().invoke(main, [*words, "--json"], catch_exceptions=False).stdout)
    assert list(told) == ["alone", "beside plan 'dense'"]
    for one in told.values():
        assert one["ticks"] > 0 and 0 < one["p50"] <= one["p99"] <= one["max"]
    printed = CliRunner().invoke(main, words, catch_exceptions=False).stdout
    assert "200 Hz loop" in printed and "beside plan 'dense'" in printed
