"""``ttscompile bench --control-hz``."""

import shutil
from pathlib import Path

import pytest

from tests.commands import as_json, refused, run
from tests.plans import store_schedules
from ttscompile.core.lattice import dense_plan, uniform_plan


def test_it_says_what_is_feasible_with_the_arithmetic(toy_compiled: Path) -> None:
    """The toy has two actions a chunk: without a margin they last for a frame and two short calls."""
    document = as_json("bench", toy_compiled, "--control-hz", 5, "--margin-ticks", 0, "--calls", 3)
    (name,) = document["loop"]["plans"]
    dense = document["loop"]["plans"][name]
    (timed,) = document["contestants"]
    assert name == timed["label"] == "dense"
    assert dense["feasible"]
    assert (dense["play"], dense["predicted"]) == pytest.approx((0.4, 0.4))
    assert dense["needed"] == pytest.approx(0.2 + 2 * dense["latency"])
    assert dense["latency"] * 1e3 == pytest.approx(max(timed["times_ms"]))
    assert dense["latency"] * 1e3 >= timed["median_ms"]


def test_what_is_not_feasible_is_exit_status_1(toy_compiled: Path) -> None:
    result = run("bench", toy_compiled, "--control-hz", 5, "--calls", 3)
    assert result.exit_code == 1
    assert "too slow" in result.stdout
    assert "ms > 400 ms = 2 actions at 5 Hz" in result.stdout


@pytest.mark.compiles
def test_the_baseline_is_named_as_one(toy_compiled: Path, tmp_path: Path) -> None:
    calibrated = shutil.copytree(toy_compiled, tmp_path / "compiled")
    plans = {"uniform": uniform_plan(5, 5, 1), "schedule": dense_plan(5, 5)}  # the baseline is the faster one
    store_schedules(calibrated, None, plans, "schedule", {"learned": ["schedule"]})
    options = ("--control-hz", 10, "--margin-ticks", 0, "--calls", 3, "--plan", "uniform")
    told = run("bench", calibrated, *options).stdout
    assert "uniform (baseline) " in told and "Not for a robot." in told


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--control-hz", 25, "--policy-hz", 10], "no multiple of policy_hz"),
        (["--control-hz", 10, "--plan", "quick"], "no plan 'quick'"),
        (["--margin-ticks", 1], "--margin-ticks is for --control-hz: give it too"),
    ],
)
def test_bad_usage_is_exit_status_2(toy_compiled: Path, arguments: list[object], message: str) -> None:
    assert message in refused("bench", toy_compiled, *arguments)
