"""What a build says of the plan that it chose, and where its times are from."""

from typing import Any

import pytest

from ttscompile.measure import machine
from ttscompile.measure.units import rounded_up
from ttscompile.report.facts import chosen, remarks, score_table

ROW = {"told": "4 of 16 steps", "distance": 0.0512, "interval": [0.03, 0.071], "within": 0.0568, "milliseconds": 7.412}
DENSE = {"name": "dense", "told": "all", "distance": 0.0, "interval": [0.0, 0.0], "milliseconds": 147.0, "worst": 150.0}


def built(default: str = "schedule", budget: dict[str, float] | None = None, **fields: Any) -> dict[str, Any]:
    row = {"name": "schedule", **ROW, "worst": 9.04, "calls": 16, **fields}
    return {"frontier": [row, DENSE], "default_plan": default, "budget": budget or {}, "other_noise": 0.1}


def test_without_a_deadline_the_longest_call_is_told() -> None:
    (told,) = chosen(built())
    assert told == (
        "Chosen among 2 plans: 4 of 16 steps: 0.051 of what other noise changes, 0.071 at worst; 7.41 ms a call on the"
        " machine that built it, 9.04 at worst. Not driven yet: evaluate it before a robot moves"
        " (examples/evaluation/README.md)."
    )


def test_the_distance_is_that_which_confirms_the_choice() -> None:
    (told,) = chosen(built(confirmed={"distance": 0.064, "interval": [0.04, 0.0912]}))
    assert told.startswith("Chosen among 2 plans: 4 of 16 steps: 0.064 of what other noise changes, 0.091 at worst;")


def test_the_table_has_both_distances_where_there_are_two() -> None:
    score = {"distance": 0.0512, "sparsity": 0.75, "flops_saved": 0.7}
    record = built(confirmed={"distance": 0.064, "interval": [0.04, 0.0912]})
    record["plans"] = {"schedule": score, "original.3": {**score, "distance": 0.09}}
    table = score_table(record)
    assert table.head[1:3] == ("distance from the original", "confirmed on other calls")
    assert [row[:3] for row in table.rows] == [("schedule", "0.051", "0.064"), ("original.3", "0.090", "")]
    table = score_table({**record, "frontier": built()["frontier"]})
    assert table.head[2] == "mean action error" and table.rows[0][:2] == ("schedule", "0.051")


def test_with_one_it_is_the_99th_percentile_of_what_is_allowed() -> None:
    (told,) = chosen(built(budget={"latency_ms": 40.0}, calls=200))
    assert "; 7.41 ms a call on the machine that built it, 9.04 at the 99th percentile of 40 allowed. Not" in told


def test_where_the_original_stays_the_default_it_is_told_how_to_take_the_nearest() -> None:
    """0.2272 is the least bound that allows 0.159, and 0.284 at worst."""
    (told,) = chosen(built("dense", distance=0.159, interval=[-0.12, 0.284], within=0.2272))
    assert told == (
        "No plan is surely within 0.1 of the original, so the default is 'dense', which is the original and takes 147"
        " ms a call. The nearest of 2 plans is 'schedule', 4 of 16 steps: 0.16 of what other noise changes, 0.28 at"
        " worst; 7.41 ms a call on the machine that built it, 9.04 at worst. Not driven yet: evaluate it before a robot"
        " moves (examples/evaluation/README.md). 'ttscompile bench DIR --choose --plan schedule' makes it the default;"
        " a build with --error 0.23, or with more recorded episodes, may."
    )
    (told,) = chosen(built("dense", {"latency_ms": 200.0, "max_distance": 0.05}))
    assert told.startswith("No plan that keeps the deadline is surely within 0.05 of the original, so")


def test_times_of_another_processor_are_said_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "cpuinfo", lambda: {"model name": "Xeon, old"})
    here = machine.timed_on(2)
    assert here == "Xeon, old, 2 threads"
    assert machine.elsewhere(None) is None and machine.elsewhere(here) == f"timed on {here}"
    there = (
        "timed on Orin, 1 thread; this is Xeon, old: 'ttscompile bench DIR --choose' chooses by the times of this one"
    )
    assert machine.elsewhere("Orin, 1 thread") == there
    assert f"The plans were {there}." in remarks(built() | {"timed_on": "Orin, 1 thread"})
    assert not any("timed on" in told for told in remarks(built()))


def test_a_bound_is_rounded_up() -> None:
    assert [rounded_up(x) for x in (0.2, 0.2001, 0.2272)] == ["0.2", "0.21", "0.23"]
