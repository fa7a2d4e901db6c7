"""The script that times steps that are evaluated together."""

import json
from pathlib import Path

import at_once
import pytest
from click.testing import CliRunner

from tests.calibration import policies
from tests.once import Once


def test_the_share_is_of_as_many_rows(once: Once, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(at_once, "loop_ms", lambda policy, observations, rows: 3.0 + rows)  # one row takes 4
    row = at_once.measured(str(policies.compiled(once)), (2, 8), 3, 1)
    assert (row.ms, row.shares) == (4.0, {2: 5 / 8, 8: 11 / 32})


def test_it_times_a_policy_and_refuses_what_is_no_number_of_rows(once: Once) -> None:
    directory: Path = policies.compiled(once)
    told = CliRunner().invoke(at_once.main, [f"{directory}:dense", "--rows", "4", "--rounds", "2", "--json"])
    assert told.exit_code == 0, told.output
    (row,) = json.loads(told.stdout)["policies"]
    assert row["ms"] > 0
    assert row["shares"]["4"] > 0
    for word in ("1", "x"):
        assert CliRunner().invoke(at_once.main, [str(directory), "--rows", word]).exit_code == 2
