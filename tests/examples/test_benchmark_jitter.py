"""How late a loop wakes, alone and beside a plan."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from jitter import main, measure_jitter

from tests.once import Once
from tests.runtimes.toys import toy_program, written_artifact


@pytest.mark.slow
def test_the_loop_is_measured_alone_and_beside_the_plan(once: Once) -> None:
    compiled: Path = once.folder("toy", lambda directory: written_artifact(toy_program(), directory))
    words = [str(compiled), "--policy-hz", "10", "--seconds", "0.2"]
    told = json.loads(CliRunner().invoke(main, [*words, "--json"], catch_exceptions=False).stdout)
    assert list(told) == ["alone", "beside plan 'dense'"]
    for one in told.values():
        assert one["ticks"] > 0 and 0 < one["p50"] <= one["p99"] <= one["max"]
    printed = CliRunner().invoke(main, words, catch_exceptions=False).stdout
    assert "200 Hz loop" in printed and "beside plan 'dense'" in printed


@pytest.mark.alone
def test_jitter_is_measured() -> None:
    def work() -> None:
        time.sleep(0.001)

    made = measure_jitter(200, 0.25, work)
    assert made.ticks == 50
    assert made.work_us >= 1000
    assert 0 <= made.p50 <= made.p99 <= made.max
    assert made.late <= made.ticks
    slow = measure_jitter(200, 0.05, lambda: time.sleep(0.02))
    assert slow.late >= slow.ticks - 2  # a loop whose work is too long is late, and that is seen
