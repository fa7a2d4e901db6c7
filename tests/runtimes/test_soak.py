"""A short soak on a toy whose plan changes from call to call and reads the rollout cache."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ttscompile.artifact import Artifact

from .soak import EPISODE, median_slope

pytestmark = pytest.mark.alone

SOAK = Path(__file__).with_name("soak.py")


def test_calls_are_repeatable_and_leave_nothing_behind(pruned: Artifact) -> None:
    # A process of its own: this one has the memory of a thousand other tests to give back or to keep.
    command = [sys.executable, str(SOAK), str(pruned.path), "--calls", str(60 * EPISODE)]
    result = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert result["repeatable"]
    assert len(result["rss_mb"]) == 10
    assert result["growth_kb_a_call"] < 0.25, result  # one more [K, blocks] array kept a call would be seen
    assert 0 < result["p50_ms"] <= result["p99_ms"]


@pytest.mark.parametrize(
    ("memory", "slope"),
    [([5.0] * 8 + [15.0], 0.0), ([1.0, 2.0, 3.0, 4.0], 1.0), ([1.0, 2.0, 9.0, 4.0], 1.0), ([7.0], 0.0)],
)
def test_a_step_is_no_growth_and_a_slope_is(memory: list[float], slope: float) -> None:
    assert median_slope(memory) == pytest.approx(slope)
