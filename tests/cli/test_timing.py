"""What takes part in a timing, what a turn is, and how times are written."""

import shutil
import time
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from tests.passes.specs import toy_spec
from tests.plans import store_schedules
from ttscompile import Affine, Noise
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.contestants import Way, _different_statistics, contestants, print_comparison
from ttscompile.cli.output import table
from ttscompile.core.lattice import Source, uniform_plan
from ttscompile.measure.points import Comparison, MeasuredPoint
from ttscompile.measure.units import flops, ms
from ttscompile.report.timing import Contestant, measure
from ttscompile.runtimes.random_calls import Observation


def test_policies_of_one_shape_are_told_apart_by_their_statistics() -> None:
    plain = toy_spec()
    scaled = Affine(np.full(3, 2.0), np.zeros(3, np.float32))
    observed = replace(plain, observations={"obs": replace(plain.observations["obs"], normalizer=scaled)})
    one, zero = np.ones(2, np.float32), np.zeros(2, np.float32)
    acting = replace(plain, chunk=replace(plain.chunk, normalizer=Affine(one, one)))
    moved = replace(plain, chunk=replace(plain.chunk, normalizer=Affine(one, zero)))
    assert _different_statistics(plain, plain) == []
    assert _different_statistics(observed, observed) == []
    assert _different_statistics(plain, observed) == ["observation 'obs'"]
    assert _different_statistics(acting, moved) == ["the action"]


def test_of_several_calls_in_a_row_the_last_is_timed_and_each_has_its_own_observation() -> None:
    seen: dict[str, list[float]] = {"slow at first": [], "quick": []}

    def contestant(label: str) -> Contestant:
        def call(obs: Observation, noise: Noise) -> None:
            seen[label].append(float(obs["obs"].sum()))
            time.sleep(0.02 if label == "slow at first" and len(seen[label]) % 3 else 0)

        return Contestant(label, "dense", call, lambda: None, spec, None)

    spec = toy_spec()
    slow, quick = measure([contestant(label) for label in seen], calls=3, seed=0, warm_up=1, in_a_row=3)
    assert len(slow.times_ms) == len(quick.times_ms) == 3
    assert slow.median_ms < 15
    for observations in seen.values():
        assert len(observations) == len(set(observations)) == 12
    assert seen["slow at first"] == seen["quick"]


def test_plans_that_follow_each_other_share_no_memory(toy_compiled: Path, tmp_path: Path) -> None:
    calibrated = shutil.copytree(toy_compiled, tmp_path / "compiled")
    rollout = np.full((5, 5), Source.ROLLOUT, np.int8)
    rollout[0] = Source.COMPUTE
    plans = {"a": uniform_plan(5, 5, 2), "b": uniform_plan(5, 5, 3), "c": uniform_plan(5, 5, 4), "reads": rollout}
    store_schedules(calibrated, None, plans, "a", {"learned": ["schedule"]})
    entered = contestants({"": load_artifact(calibrated)}, (), [Way()])
    assert [one.plan for one in entered] == ["dense", "a", "b", "c", "reads"]
    dense, a, b, c, reads = (one.policy for one in entered)
    assert dense is b and a is c and a is not b
    assert reads not in (a, b)


@pytest.mark.parametrize("width", [110, 80, 60, 50])
def test_a_table_breaks_no_number_where_there_is_room(width: int) -> None:
    """As rich does it, one of 80 columns has '55.8..5' above '9.3': it narrows whichever column is widest."""
    made = table("", "ms a call", "quartiles", "speed-up", "FLOPs", "reused", "prologue")
    made.add_row("schedule (default)", "57.57", "55.8..59.3", "16.3 x", "156 MFLOP", "87.5%", "0.38")
    console = Console(file=StringIO(), width=width)
    with console.capture() as captured:
        console.print(made)
    lines = captured.get().splitlines()
    assert max(map(len, lines)) <= width
    words = " ".join(lines).split()
    assert ({"55.8..59.3", "57.57", "schedule", "(default)", "prologue", "speed-up"} <= {*words}) is (width > 50)


def test_an_interval_that_one_call_cannot_give_is_unknown() -> None:
    told: dict[str, Any] = {"error": 0.2, "error_p90": 0.3, "quartiles_ms": (9.0, 11.0), "sparsity": 0.5, "flops": 1e9}
    points = [
        MeasuredPoint("this artifact", name, 0.4, 10.0, interval, **told)
        for name, interval in (("one", (-1e15, 1e15)), ("many", (0.3, 0.5)))
    ]
    console = Console(file=StringIO(), width=110)
    with console.capture() as captured:
        print_comparison(Comparison(tuple(points), 1, (3,), 1, 0.5, {}, ()), console)
    rows = [line.split() for line in captured.get().splitlines() if " 0.400 " in line]
    assert [row[row.index("0.400") + 1] for row in rows] == ["unknown", "0.300..0.500"]


def test_long_times_have_no_exponent() -> None:
    assert [ms(time, 4) for time in (0.12345, 33.274, 9999.4, 11630.2)] == ["0.1235", "33.27", "9999", "11630"]
    assert [ms(time) for time in (33.27, 999.6, 1030.4)] == ["33.3", "1000", "1030"]
    assert [flops(count) for count in (2.5e6, 999_700, 999.6e9)] == ["2.5 MFLOP", "1000 kFLOP", "1000 GFLOP"]
