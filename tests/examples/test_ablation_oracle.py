"""What the script of the oracle prints."""

import json
from pathlib import Path

import pytest
from choosing import SINGLE
from click.testing import CliRunner
from oracle import main

from tests.calibration import policies
from tests.once import Once
from ttscompile.errors import CalibrationError


@pytest.mark.slow
def test_it_prints_a_table_or_json(once: Once, tmp_path: Path) -> None:
    calls = policies.record(tmp_path / "calls.npz")
    asked = [str(policies.compiled(once)), "--trajectories", str(calls)]
    small = [*asked, "--computed-steps", "2", "--schedules", "2", "--calls", "4", "--draws", "2"]
    result = CliRunner().invoke(main, small, catch_exceptions=False)
    assert result.exit_code == 0
    assert "who chooses knows" in result.stdout and SINGLE in result.stdout
    assert "4 observations with 2 draws of noise each" in " ".join(result.stdout.split())
    made = json.loads(CliRunner().invoke(main, [*small, "--json"], catch_exceptions=False).stdout)
    assert made["budget"] == 2 and made["choices"][0]["name"] == SINGLE
    with pytest.raises(CalibrationError, match="found 99"):
        CliRunner().invoke(main, [*asked, "--computed-steps", "99"], catch_exceptions=False)
