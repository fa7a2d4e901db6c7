"""The benchmark's own arithmetic; no time is asserted."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmark import WARM_UP, Contestant, Measurement, measure, random_plan, scripted_windows, speed_table, to_json
from variants import NoiseShape

from tests.examples.printed import printed
from ttscompile import Source
from ttscompile.core.lattice import illegal_cells
from ttscompile.measure.machine import fingerprint, one_line

SHAPE = NoiseShape(steps=4, sample=(16, 2), stochastic=False)


class Scripted:
    """Answers nothing, and writes down who was asked what."""

    def __init__(self, name: str, log: list[Any], reports: bool) -> None:
        self.name, self.log, self.reports = name, log, reports
        self.last_report: Any = None

    def reset(self) -> None:
        self.log.append((self.name, "reset", None))

    def predict_action(self, obs: Any, *, noise: Any, plan: Any = None) -> Any:
        self.log.append((self.name, plan, noise.initial.tobytes()))
        if self.reports:
            timings = SimpleNamespace(prologue=1.0, pruner=2.0)
            executed = np.full((1, 4, 2), Source.TIMESTEP, np.int8)
            executed[:, 0] = Source.COMPUTE
            self.last_report = SimpleNamespace(plan=executed, flops=(8.0,), timings=timings)
        return {"action": np.zeros((1, 8, 2), np.float32)}


@pytest.mark.parametrize("computed", [0.01, 0.05, 0.5, 1.0])
def test_random_plan_has_its_share_and_is_legal_when_warm(computed: float) -> None:
    plan = random_plan(100, 24, computed, seed=3)
    groups = [i % 3 for i in range(24)]
    assert plan.dtype == np.int8
    assert np.count_nonzero(plan == Source.COMPUTE) == round(computed * 2400)
    assert (plan[0] == Source.COMPUTE).all()
    assert not illegal_cells(plan, groups, np.ones((100, 24), dtype=bool)).any()
    assert computed == 1.0 or len(np.unique(plan)) == 4
    np.testing.assert_array_equal(plan, random_plan(100, 24, computed, seed=3))


def test_contestants_take_turns_on_the_same_noise() -> None:
    log: list[Any] = []
    first_policy: Any = Scripted("a", log, reports=False)
    second_policy: Any = Scripted("b", log, reports=True)
    given = np.array([[Source.COMPUTE] * 2] + [[Source.ROLLOUT] * 2] * 3, np.int8)
    contestants = [
        Contestant("eager", first_policy, None, 80.0, SHAPE),
        Contestant("given", second_policy, given, 80.0, SHAPE),
    ]
    first, second = measure(contestants, runs=4)
    assert log[:2] == [("a", "reset", None), ("b", "reset", None)]
    rounds = [log[i : i + 2] for i in range(2, len(log), 2)]
    assert len(rounds) == WARM_UP + 4
    assert [pair[0][0] for pair in rounds] == ["a", "b"] * 3 + ["a"]
    assert all(pair[0][2] == pair[1][2] for pair in rounds)
    plans = [plan for name, plan, _ in log if name == "b"][1:]
    np.testing.assert_array_equal(plans[0], np.full((4, 2), Source.COMPUTE))
    assert all(plan is given for plan in plans[1:])
    assert (first.flops, first.sparsity, first.plan) == (80.0, 0.0, None)
    assert (second.flops, second.sparsity, second.prologue_ms, second.pruner_ms) == (8.0, 0.75, 1.0, 2.0)
    assert len(first.ms) == len(second.ms) == 4


def test_ratios_are_of_medians() -> None:
    measurements = [
        Measurement("eager", (900.0, 1000.0, 5000.0), None, None, 16e9, 0.0, None),
        Measurement("dense", (250.0, 250.0, 250.0), 1.0, 0.0, 15e9, 0.0, None),
        Measurement("sparse", (20.0, 25.0, 26.0), 1.0, 0.5, 1e9, 0.95, None),
    ]
    assert measurements[0].median == 1000.0
    assert measurements[0].quartiles == (950.0, 3000.0)
    row = next(line for line in printed(speed_table(measurements, threads=1)) if "sparse" in line)
    assert "25.00" in row
    assert "40.0" in row  # calls a second, and times eager
    assert "10.0" in row
    document = to_json(measurements, {"prologue": 0.01, "pruner": 0.002}, threads=1)
    assert document["contestants"][2]["times_eager"] == 40.0
    assert document["contestants"][2]["times_dense"] == 10.0
    assert document["flops_shares"] == {"prologue": 0.01, "pruner": 0.002}


def test_scripted_windows_move() -> None:
    windows = scripted_windows(4)
    assert [window.shape for window in windows] == [(1, 2, 20)] * 4
    assert len({window.tobytes() for window in windows}) == 4


def test_fingerprint_names_the_machine() -> None:
    machine = fingerprint()
    assert machine["cores"] >= 1
    assert machine["processor"]
    assert str(machine["cores"]) in one_line(machine)
